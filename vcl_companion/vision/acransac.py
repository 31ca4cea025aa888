"""A-contrario RANSAC: the threshold comes from the data (IV-B, IV-D).

L. Moisan, P. Moulon, P. Monasse, Automatic homographic registration of a pair
of images, with a contrario elimination of outliers, IPOL 2012. If all matches
were wrong, an error of at most e would happen with probability alpha(e). The
number of false alarms of "k of n matches agree within e" is

    NFA = n_models (n - s) C(n, k) C(k, s) alpha(e)^(k - s)

and the model and the k with the least NFA win, whatever their e. At NFA >= 1 a
heap of wrong matches would do as well: nothing is found.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]

# Errors below this are alike: 2^-10 px is no detector's precision.
_FINEST_SQUARED = 2.0**-20
_OCTAVES = 44
# A double's exponent and its first two bits of mantissa: 4 bins per doubling, without a log.
_SHIFT = 50
_FIRST_BIN = int(np.float64(_FINEST_SQUARED).view(np.int64)) >> _SHIFT
_LOG_EDGES = np.log(
    (np.arange(_FIRST_BIN, _FIRST_BIN + 4 * _OCTAVES + 1, dtype=np.int64) << _SHIFT).view(
        np.float64
    )
)
THRESHOLD_SIGMAS = 2.5
"""What a threshold found from the data is taken for, in sigmas of the noise behind it."""
# A detector's features agree with a right model to so many px, or nearly.
_PRECISE_PX = 2.5
_MODELS_PER_BATCH = 64
_MAX_REFITS = 4
# One of so many samples is drawn among the inliers of the best model.
_AMONG_INLIERS = 4


class Problem(Protocol):
    """What is fitted to what; errors are in px.

    Attributes:
        n_data: how many matches there are.
        sample_size: how many fix a model.
        max_models: how many models one sample may give.
        log_alpha: log of the probability that a wrong match errs by at most 1 px.
        dimension: alpha grows with this power of the error: 1 from a line, 2 from a point.
    """

    @property
    def n_data(self) -> int: ...  # noqa: D102
    @property
    def sample_size(self) -> int: ...  # noqa: D102
    @property
    def max_models(self) -> int: ...  # noqa: D102
    @property
    def log_alpha(self) -> float: ...  # noqa: D102
    @property
    def dimension(self) -> int: ...  # noqa: D102

    def fit(self, samples: Indices) -> Array:
        """Return the (K, ...) models of (B, sample_size) samples."""

    def squared_errors(self, models: Array) -> Array:
        """Return the (K, n_data) squared errors, px^2; inf for what cannot be an inlier."""

    def refit(self, model: Array, threshold: float) -> Array:
        """Return one model moved to fit best all that err by about ``threshold`` px or less."""


@dataclass(frozen=True)
class AcRansacOptions:
    """How long to search.

    Attributes:
        max_samples: at most.
        confidence: probability of having drawn good samples before stopping.
        max_threshold_px: no larger error is an inlier's; infinite leaves it to the data.
        nfa: ``sorted`` sorts the errors of every model; ``histogram`` sorts only
            those whose histogram does not rule them out, and finds the same.
    """

    max_samples: int = 20000
    confidence: float = 0.999
    max_threshold_px: float = np.inf
    nfa: Literal["histogram", "sorted"] = "histogram"

    def __post_init__(self) -> None:
        if self.max_samples < 1 or not 0.0 < self.confidence < 1.0 or self.max_threshold_px <= 0:
            raise ValueError(
                "a-contrario search needs max_samples >= 1, 0 < confidence < 1, a threshold > 0"
            )


@dataclass(frozen=True, eq=False)
class Consensus:
    """The most meaningful model.

    Attributes:
        model: as the problem writes it.
        inliers: (N,) bool, errors up to the threshold.
        threshold_px: the one found.
        log_nfa: natural logarithm of the number of false alarms; negative.
        n_samples: how many were drawn.
    """

    model: Array
    inliers: Mask
    threshold_px: float
    log_nfa: float
    n_samples: int


@dataclass(frozen=True)
class NotFound:
    """Nothing can be believed, and why."""

    reason: str


@dataclass(frozen=True, eq=False)
class Score:
    """The least NFA of one model: ``k`` matches within the square root of ``threshold_squared``."""

    log_nfa: float
    k: int
    threshold_squared: float


class FalseAlarms:
    """The NFA of one problem, its combinatorial part tabulated."""

    def __init__(self, problem: Problem, max_threshold_px: float = np.inf) -> None:
        n, s = problem.n_data, problem.sample_size
        k = np.arange(n + 1)
        log_choose_n = gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1)
        log_choose_k = gammaln(k + 1) - gammaln(s + 1) - gammaln(np.maximum(k - s, 0) + 1)
        # log (n_models (n - s) C(n, k) C(k, s)); no k up to s says anything
        self._log_tests = np.where(
            k > s, np.log(problem.max_models * max(n - s, 1)) + log_choose_n + log_choose_k, np.inf
        )
        self._s = s
        self._log_alpha = problem.log_alpha
        # alpha of a squared error e2 is exp(log_alpha + half_dimension log e2)
        self._half_dimension = 0.5 * problem.dimension
        certain = -problem.log_alpha / self._half_dimension
        self._largest = min(max_threshold_px**2, float(np.exp(min(certain, _LOG_EDGES[-1]))))

    def exact(self, squared_errors: Array) -> Score:
        """Score (N,) squared errors by sorting them."""
        return self.best(squared_errors[None], "sorted")[1]

    def bounds(self, squared_errors: Array) -> tuple[float, float]:
        """Return what the histogram knows of the log NFA of (N,) errors: not below, not above."""
        return _histogram_bounds(
            squared_errors, self._log_tests, self._s, self._log_alpha, self._half_dimension,
            self._largest, _LOG_EDGES, np.zeros(len(_LOG_EDGES), dtype=np.int64),
        )  # fmt: skip

    def fewest_better(self, score: Score) -> int:
        """Return how few matches mean more than a score does, if they agree as a right model's do.

        Where matches lie close together, half of them may agree with a wrong model to a hundred
        px, beyond chance: they say nothing of how many agree with the right one.
        """
        squared = min(score.threshold_squared, _PRECISE_PX**2)
        log_alpha = min(self._log_alpha + self._half_dimension * np.log(squared), 0.0)
        log_nfa = self._log_tests + (np.arange(len(self._log_tests)) - self._s) * log_alpha
        better = np.flatnonzero(log_nfa <= score.log_nfa)
        return min(int(better[0]), score.k) if len(better) else score.k

    def best(self, squared_errors: Array, nfa: str) -> tuple[int, Score]:
        """Return which of K models, (K, N) squared errors, is most meaningful, and its score."""
        index, k, threshold_squared, log_nfa = _best_model(
            squared_errors, self._log_tests, self._s, self._log_alpha, self._half_dimension,
            self._largest, _LOG_EDGES, nfa == "histogram",
        )  # fmt: skip
        return index, Score(log_nfa, k, threshold_squared)


def ac_ransac(
    problem: Problem, rng: np.random.Generator, options: AcRansacOptions | None = None
) -> Consensus | NotFound:
    """Find the most meaningful model.

    Most samples come from everywhere to the end, and only they count for
    stopping: sampling among the inliers of the best model (the others, once it
    is meaningful) sharpens it, but cannot keep another one from being found.
    The best model of every batch is refitted to what agrees with it, best of all
    or not, for a good one may look bad before.

    Args:
        problem: data and model.
        rng: of the samples; the same one gives the same answer.
        options: how long to search.
    """
    options = options or AcRansacOptions()
    n, s = problem.n_data, problem.sample_size
    if n <= s + 1:
        return NotFound(f"{n} matches, more than {s + 1} needed")
    alarms = FalseAlarms(problem, options.max_threshold_px)
    best: tuple[Array, Score] | None = None
    pool: Indices = np.arange(0)
    batch = max(8, min(_MODELS_PER_BATCH, 2**16 // n))
    drawn, needed, total = 0, float(options.max_samples), 0
    while drawn < needed:
        samples = distinct(rng.random((batch, s)), n)
        everywhere = batch
        if len(pool) > s + 1:
            everywhere = batch - batch // _AMONG_INLIERS
            samples[everywhere:] = pool[distinct(rng.random((batch - everywhere, s)), len(pool))]
        drawn += everywhere
        total += batch
        models = problem.fit(samples)
        if len(models) == 0:
            continue
        index, score = alarms.best(problem.squared_errors(models), options.nfa)
        if not np.isfinite(score.log_nfa):
            continue
        to_beat = best[1].log_nfa if best is not None else np.inf
        model, score = _refitted(problem, alarms, models[index], score, to_beat)
        if score.log_nfa >= to_beat:
            continue
        best = (model, score)
        if score.log_nfa < 0.0:
            errors = problem.squared_errors(model[None])[0]
            pool = np.flatnonzero(errors <= score.threshold_squared)
            least = alarms.fewest_better(score)
            needed = min(options.max_samples, _samples_needed(least, n, s, options.confidence))
    if best is None or best[1].log_nfa >= 0.0:
        return NotFound(f"no more of the {n} matches agree than wrong ones would by chance")
    model, score = best
    inliers = problem.squared_errors(model[None])[0] <= score.threshold_squared
    threshold = float(np.sqrt(score.threshold_squared))
    return Consensus(model, np.asarray(inliers), threshold, score.log_nfa, total)


def consensus_of(
    problem: Problem,
    model: Array,
    max_threshold_px: float = np.inf,
    possible: Mask | None = None,
) -> Consensus:
    """Judge one given model as ``ac_ransac`` would; its log NFA may be positive or infinite.

    Args:
        problem: data and model.
        model: as the problem writes it.
        max_threshold_px: no larger error is an inlier's.
        possible: (N,) bool, which matches may be inliers at all; None for all.
    """
    errors = problem.squared_errors(model[None])[0]
    if possible is not None:
        errors = np.where(possible, errors, np.inf)
    score = FalseAlarms(problem, max_threshold_px).exact(errors)
    inliers = np.asarray(errors <= score.threshold_squared)
    return Consensus(model, inliers, float(np.sqrt(score.threshold_squared)), score.log_nfa, 0)


def _refitted(
    problem: Problem, alarms: FalseAlarms, model: Array, score: Score, to_beat: float
) -> tuple[Array, Score]:
    """Refit to the inliers, whose number and threshold change with it, while that helps.

    One that the first time does not come near the best so far is given up.
    """
    for _ in range(_MAX_REFITS):
        moved = problem.refit(model, float(np.sqrt(score.threshold_squared)))
        moved_score = alarms.exact(problem.squared_errors(moved[None])[0])
        gain = score.log_nfa - moved_score.log_nfa
        if not gain > 0.0:
            break
        model, score = moved, moved_score
        if gain < 0.1 or score.log_nfa > 0.5 * to_beat:
            break
    return model, score


def _samples_needed(n_inliers: int, n: int, s: int, confidence: float) -> float:
    """Return after how many samples some were surely free of wrong matches."""
    k = np.arange(s)
    good = float(np.prod((n_inliers - k) / (n - k)))
    if good >= 1.0:
        return 1.0
    return float(np.log(1.0 - confidence) / np.log1p(-good))


@compiled
def distinct(uniform: Array, n: int) -> Indices:
    """Return (B, s) rows of distinct indices below n from (B, s) uniform numbers in [0, 1)."""
    rows, s = uniform.shape
    out = np.empty((rows, s), dtype=np.int64)
    taken = np.empty(s, dtype=np.int64)
    for b in range(rows):
        for j in range(s):
            # the pick-th of those not yet taken; taken is sorted
            pick = min(int(uniform[b, j] * (n - j)), n - j - 1)
            place = 0
            while place < j and taken[place] <= pick:
                pick += 1
                place += 1
            for k in range(j, place, -1):
                taken[k] = taken[k - 1]
            taken[place] = pick
            out[b, j] = pick
    return out


@compiled
def _best_model(
    squared: Array, log_tests: Array, s: int, log_alpha: float, half_dimension: float,
    largest: float, log_edges: Array, use_histogram: bool,
) -> tuple[int, int, float, float]:  # fmt: skip
    """Return (index, k, squared threshold, log NFA) of the best of (K, N) errors."""
    n = squared.shape[1]
    counts = np.zeros(len(log_edges), dtype=np.int64)
    kept = np.empty(n)
    best_index, best_k, best_threshold, best = 0, 0, 0.0, np.inf
    for m in range(len(squared)):
        if use_histogram:
            low, _ = _histogram_bounds(
                squared[m], log_tests, s, log_alpha, half_dimension, largest, log_edges, counts
            )
            if low >= best:
                continue
        count = 0
        for i in range(n):
            # not "larger": a NaN is no inlier either
            if squared[m, i] <= largest:
                kept[count] = max(squared[m, i], _FINEST_SQUARED)
                count += 1
        ordered = np.sort(kept[:count])
        for k in range(s + 1, count + 1):
            if k < count and ordered[k] == ordered[k - 1]:
                continue
            log_nfa = log_tests[k] + (k - s) * min(
                log_alpha + half_dimension * np.log(ordered[k - 1]), 0.0
            )
            if log_nfa < best:
                best_index, best_k, best_threshold, best = m, k, ordered[k - 1], log_nfa
    return best_index, best_k, best_threshold, best


@compiled
def _histogram_bounds(
    squared: Array, log_tests: Array, s: int, log_alpha: float, half_dimension: float,
    largest: float, log_edges: Array, counts: Indices,
) -> tuple[float, float]:  # fmt: skip
    """Return bounds of the log NFA; ``counts`` comes in zero and is left so.

    All errors of a bin lie between its edges: with the lower edge no k of the bin
    has a lower NFA, with the upper edge the bin's last k has none higher.
    """
    bits = squared.view(np.int64)
    last = len(counts) - 2
    for i in range(len(squared)):
        if squared[i] <= largest:
            counts[min(max((bits[i] >> _SHIFT) - _FIRST_BIN, 0), last)] += 1
    k = 0
    low, high = np.inf, np.inf
    for b in range(last + 1):
        if counts[b] == 0:
            continue
        at_low = min(log_alpha + half_dimension * log_edges[b], 0.0)
        at_high = min(log_alpha + half_dimension * log_edges[b + 1], 0.0)
        for _ in range(counts[b]):
            k += 1
            low = min(low, log_tests[k] + (k - s) * at_low)
        high = min(high, log_tests[k] + (k - s) * at_high)
        counts[b] = 0
    return low, high
