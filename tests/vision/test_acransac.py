"""A-contrario RANSAC on the smallest problem there is: lines through points of a square."""

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.acransac import (
    AcRansacOptions,
    Consensus,
    FalseAlarms,
    Indices,
    NotFound,
    ac_ransac,
    consensus_of,
    distinct,
)

SIDE_PX = 1000.0


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines (a, b, c) with a x + b y + c = 0 and (a, b) of length 1."""

    points: Array
    sample_size: int = 2
    max_models: int = 1
    dimension: int = 1
    log_alpha: float = math.log(2.0 * math.sqrt(2.0) * SIDE_PX / SIDE_PX**2)

    @property
    def n_data(self) -> int:
        return len(self.points)

    def fit(self, samples: Indices) -> Array:
        p, q = self.points[samples[:, 0]], self.points[samples[:, 1]]
        normal = (q - p)[:, ::-1] * (1.0, -1.0)
        length = np.linalg.norm(normal, axis=1)
        normal = normal[length > 0] / length[length > 0, None]
        return np.column_stack([normal, -np.einsum("ni,ni->n", normal, p[length > 0])])

    def squared_errors(self, models: Array) -> Array:
        return np.asarray((models[:, :2] @ self.points.T + models[:, 2:]) ** 2)

    def refit(self, model: Array, threshold: float) -> Array:
        near = self.points[self.squared_errors(model[None])[0] <= threshold**2]
        centre = near.mean(axis=0)
        normal = np.linalg.svd(near - centre)[2][1]
        return np.array([*normal, -normal @ centre])


def on_line(rng: np.random.Generator, n: int, y: float, slope: float, sigma: float) -> Array:
    x = SIDE_PX * rng.random(n)
    offset = sigma * math.hypot(1.0, slope) * rng.standard_normal(n)
    return np.column_stack([x, y + slope * x + offset])


def anywhere(rng: np.random.Generator, n: int) -> Array:
    return SIDE_PX * rng.random((n, 2))


def test_finds_the_line_and_a_threshold_that_follows_the_noise() -> None:
    thresholds = []
    for sigma in (0.5, 2.0, 8.0):
        rng = np.random.default_rng(1)
        data = np.vstack([on_line(rng, 120, 300.0, 0.3, sigma), anywhere(rng, 180)])
        found = ac_ransac(Lines(data), rng)
        assert isinstance(found, Consensus)
        assert 1.0 * sigma < found.threshold_px < 4.0 * sigma
        assert found.inliers[:120].mean() > 0.85
        assert found.inliers[120:].mean() < 0.1
        assert found.log_nfa < -50.0
        model = found.model * np.sign(found.model[1])
        assert abs(model[0] + 0.3 * model[1]) < 0.005 * sigma
        thresholds.append(found.threshold_px)
    assert thresholds == sorted(thresholds)


def test_chance_is_not_found() -> None:
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(100):
        result = ac_ransac(Lines(anywhere(rng, 80)), rng, AcRansacOptions(max_samples=300))
        found += isinstance(result, Consensus)
        if isinstance(result, NotFound):
            assert "by chance" in result.reason
    # The NFA bounds the expected number of such finds per data set, refits apart.
    assert found <= 3


def test_too_few_matches_are_refused_with_a_reason() -> None:
    result = ac_ransac(Lines(np.zeros((3, 2))), np.random.default_rng(0))
    assert isinstance(result, NotFound)
    assert "3 matches" in result.reason


def test_data_that_fit_nothing_are_not_found() -> None:
    result = ac_ransac(
        Lines(np.zeros((50, 2))), np.random.default_rng(0), AcRansacOptions(max_samples=100)
    )
    assert isinstance(result, NotFound)


def test_the_same_generator_gives_the_same_answer() -> None:
    data = anywhere(np.random.default_rng(3), 200)
    data[:70] = on_line(np.random.default_rng(4), 70, 100.0, 0.5, 1.0)
    one, other = (ac_ransac(Lines(data), np.random.default_rng(5)) for _ in range(2))
    assert isinstance(one, Consensus)
    assert isinstance(other, Consensus)
    assert np.array_equal(one.model, other.model)
    assert (one.log_nfa, one.n_samples) == (other.log_nfa, other.n_samples)


@pytest.mark.parametrize("seed", range(12))
def test_a_meaningful_line_does_not_keep_the_better_one_from_being_found(seed: int) -> None:
    """Found first in most runs: many points, loosely. Better: fewer, but sharp."""
    rng = np.random.default_rng(seed)
    loose, sharp = on_line(rng, 110, 200.0, 0.1, 6.0), on_line(rng, 60, 800.0, -0.4, 0.1)
    data = np.vstack([loose, sharp, anywhere(rng, 60)])
    nfas = [
        consensus_of(Lines(data), np.array([-slope, 1.0, -y]) / math.hypot(1.0, slope)).log_nfa
        for y, slope in ((200.0, 0.1), (800.0, -0.4))
    ]
    assert nfas[1] < nfas[0] < -50.0
    found = ac_ransac(Lines(data), rng, AcRansacOptions(confidence=1.0 - 1e-12))
    assert isinstance(found, Consensus)
    assert found.inliers[110:170].mean() > 0.85
    assert found.log_nfa < 0.9 * nfas[1]


@dataclass(frozen=True, eq=False)
class Watched(Lines):
    """Lines that remember which samples were drawn."""

    drawn: list[Indices] = field(default_factory=list)

    def fit(self, samples: Indices) -> Array:
        self.drawn.append(samples.copy())
        return super().fit(samples)


def test_most_samples_come_from_everywhere_to_the_end_and_some_from_the_inliers() -> None:
    rng = np.random.default_rng(10)
    n_good, n = 60, 300
    data = np.vstack([on_line(rng, n_good, 300.0, 0.3, 1.0), anywhere(rng, n - n_good)])
    problem = Watched(data)
    found = ac_ransac(problem, rng)
    assert isinstance(found, Consensus)
    assert sum(map(len, problem.drawn)) == found.n_samples
    later = np.vstack(problem.drawn[1:])
    assert len(later) >= 64
    pure = found.inliers[later].all(axis=1).mean()
    by_chance = float(found.inliers.mean()) ** 2
    # One of four is drawn among the inliers.
    assert 0.2 < pure < 0.25 + 0.75 * by_chance + 0.1
    assert len(np.unique(later)) > 0.6 * n


def test_both_kinds_of_nfa_find_the_same() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        data = np.vstack([on_line(rng, 60, 300.0, 0.3, 2.0), anywhere(rng, 90)])
        by_sorting, by_histogram = (
            ac_ransac(Lines(data), np.random.default_rng(seed), AcRansacOptions(nfa=kind))
            for kind in ("sorted", "histogram")
        )
        assert isinstance(by_sorting, Consensus)
        assert isinstance(by_histogram, Consensus)
        assert by_sorting.log_nfa == by_histogram.log_nfa
        assert by_sorting.threshold_px == by_histogram.threshold_px
        assert np.array_equal(by_sorting.inliers, by_histogram.inliers)


@given(st.lists(st.floats(0.0, 1e9) | st.just(math.inf), min_size=4, max_size=60))
def test_the_histogram_bounds_the_exact_nfa(errors: list[float]) -> None:
    squared = np.array(errors)
    alarms = FalseAlarms(Lines(np.zeros((len(squared), 2))))
    exact = alarms.exact(squared)
    low, high = alarms.bounds(squared)
    assert low <= exact.log_nfa + 1e-9
    assert exact.log_nfa <= high + 1e-9
    if math.isfinite(exact.log_nfa):
        # A bin is at most a quarter wide in the squared error, an eighth in the error.
        assert exact.log_nfa - low < 0.5 * math.log(1.25) * len(squared) + 1e-9


@given(st.lists(st.floats(1e-3, 1e5), min_size=3, max_size=20, unique=True))
def test_the_exact_nfa_is_the_definition(errors: list[float]) -> None:
    problem = Lines(np.zeros((len(errors), 2)))
    n, s = len(errors), problem.sample_size
    ordered = sorted(errors)
    expected = math.inf
    for k in range(s + 1, n + 1):
        alpha = math.exp(problem.log_alpha) * math.sqrt(ordered[k - 1])
        if alpha <= 1.0:
            tests = problem.max_models * (n - s) * math.comb(n, k) * math.comb(k, s)
            expected = min(expected, math.log(tests) + (k - s) * math.log(alpha))
    score = FalseAlarms(problem).exact(np.array(errors))
    assert score.log_nfa == pytest.approx(expected, abs=1e-6)
    if math.isfinite(expected):
        assert ordered[score.k - 1] == pytest.approx(score.threshold_squared)


@given(st.lists(st.floats(1e-3, 1e5), min_size=3, max_size=20, unique=True))
def test_no_more_are_needed_to_mean_more_than_agree_and_fewer_if_they_agree_better(
    errors: list[float],
) -> None:
    alarms = FalseAlarms(Lines(np.zeros((len(errors), 2))))
    score = alarms.exact(np.array(errors))
    if not math.isfinite(score.log_nfa):
        return
    fewest = alarms.fewest_better(score)
    assert 2 < fewest <= score.k
    if score.threshold_squared <= 1.0:
        assert fewest == score.k
    exact = np.full(len(errors), 1e6)
    exact[:fewest] = min(score.threshold_squared, 1.0)
    assert alarms.exact(exact).log_nfa <= score.log_nfa + 1e-9


def test_errors_that_are_no_numbers_are_nobodys_inliers() -> None:
    errors = np.array([1e-4] * 10 + [np.nan, -np.nan, np.inf])
    alarms = FalseAlarms(Lines(np.zeros((13, 2))))
    assert alarms.exact(errors).k == 10
    low, high = alarms.bounds(errors)
    assert low <= alarms.exact(errors).log_nfa <= high


def test_an_upper_bound_on_the_threshold_holds() -> None:
    rng = np.random.default_rng(6)
    data = np.vstack([on_line(rng, 150, 300.0, 0.3, 6.0), anywhere(rng, 50)])
    free, bound = (
        ac_ransac(Lines(data), np.random.default_rng(7), AcRansacOptions(max_threshold_px=limit))
        for limit in (np.inf, 4.0)
    )
    assert isinstance(free, Consensus)
    assert isinstance(bound, Consensus)
    assert free.threshold_px > 8.0
    assert bound.threshold_px <= 4.0


def test_fewer_samples_are_drawn_where_more_matches_agree() -> None:
    drawn = []
    for n_good in (250, 60):
        rng = np.random.default_rng(8)
        data = np.vstack([on_line(rng, n_good, 300.0, 0.3, 1.0), anywhere(rng, 300 - n_good)])
        found = ac_ransac(Lines(data), rng)
        assert isinstance(found, Consensus)
        drawn.append(found.n_samples)
    assert drawn[0] < drawn[1] < 1000


@given(st.integers(5, 30), st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_samples_are_distinct_and_in_range(n: int, size: int, seed: int) -> None:
    rows = distinct(np.random.default_rng(seed).random((20, size)), n)
    assert rows.min() >= 0
    assert rows.max() < n
    assert all(len(set(row)) == size for row in rows.tolist())


def test_every_sample_is_as_likely_as_any_other() -> None:
    rows = distinct(np.random.default_rng(9).random((60000, 2)), 4)
    counts = np.bincount(4 * rows[:, 0] + rows[:, 1], minlength=16).reshape(4, 4)
    assert np.all(np.diag(counts) == 0)
    others = counts[~np.eye(4, dtype=bool)]
    assert np.abs(others - 5000).max() < 5 * math.sqrt(5000)


@pytest.mark.parametrize(
    "wrong", [{"max_samples": 0}, {"confidence": 1.0}, {"max_threshold_px": 0.0}]
)
def test_options_out_of_bounds_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="a-contrario"):
        AcRansacOptions(**wrong)  # type: ignore[arg-type]


def test_a_kernel_that_cannot_be_kept_on_disk_is_compiled_all_the_same() -> None:
    """Code without a file is what a package in an unwritable folder looks like to numba."""
    space: dict[str, object] = {}
    exec("def doubled(x):\n    return 2.0 * x", space)
    doubled = space["doubled"]
    assert callable(doubled)
    assert compiled(doubled)(4.0) == 8.0
