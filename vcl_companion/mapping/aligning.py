"""The similarity between two maps by landmarks of both, and how well it is known (IV-G).

Three pairs of landmarks give one; the one that most pairs agree with, each by the errors of
both its landmarks, is refined by generalized least squares. What landmarks of one map are off
by they share through its keyframes: with the whole joint covariance of both maps, what comes
out is as uncertain as it says, scale included.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from vcl_companion.geometry.rotation import Array, angle_between, skew
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.mapping.common_landmarks import Common
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.information import covariance_of, squared_distances

Mask = NDArray[np.bool_]

# So many pairs have to agree.
MIN_COMMON = 20
_SAMPLES = 800
# The search looks at so many pairs, the refinement at so many: more tell little more.
_SEARCHED, _REFINED = 1500, 300
# Two features that match show the same spot only to this; a pixel of one image does exactly.
_ALIKE_PX = 0.5
# 99.9 % of a three-dimensional Gaussian.
_CHI2_3_999 = 16.3
_SINGULAR = 1e-10
_ROUNDS = 12
# A similarity this far off is none between two maps in metres, however vague they are.
_MOST_SCALE = 1.15
_SCALE_SIGMAS = 4.0
_MAX_TURN_RAD = np.deg2rad(2.0)
# Of the support that the best has; with so much another one makes it doubtful.
_RIVAL = 0.5
# Rivals differ by more than what bends a map: by this share of its size, or this angle.
_APART, _APART_RAD = 0.1, np.deg2rad(4.0)


@dataclass(frozen=True, eq=False)
class Aligned:
    """How two maps stand to each other.

    Attributes:
        senior_from_junior: takes the one's world to the other's.
        covariance: (7, 7) of it, see ``Similarity.moved``.
        common: the pairs of landmarks that agree, each landmark in one of them.
    """

    senior_from_junior: Similarity
    covariance: Array
    common: Common


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two maps, and how well it is known."""

    map: LandmarkMap
    sure: MapUncertainty


def aligned(
    senior: Side, junior: Side, common: Common, options: MapOptions, seed: int, *, one_world: bool
) -> Aligned | NoMap:
    """Find how a map stands to another one.

    Args:
        senior: the map whose world is kept.
        junior: the other.
        common: landmarks that may be the same, wrong pairs among them.
        options: how vague a similarity may be, and how far attitudes may be off.
        seed: of the robust search.
        one_world: whether both say that they are in the same world.

    Returns:
        The similarity, or why there is none: too little in common, or nothing
        that fixes it, or two that are as good, or a scale or vertical that both
        maps' uncertainties do not explain.
    """
    if len(common.senior) < MIN_COMMON:
        return NoMap(f"the maps have {len(common.senior)} landmarks in common, {MIN_COMMON} needed")
    pairs = _Pairs(senior, junior, common)
    rng = np.random.default_rng(seed)
    limit = np.sqrt(2.0) * 3.0 * np.deg2rad(options.attitude_sigma_deg)
    first = Similarity.identity() if one_world else None
    start = _searched(pairs, np.ones(len(common.senior), dtype=bool), rng, first)
    if start is None:
        return NoMap(
            f"no place of the other map agrees with {MIN_COMMON} of {len(common.senior)} "
            "landmarks that may be in common"
        )
    agree = pairs.squared(start) < _CHI2_3_999
    rival = _searched(pairs, ~agree, rng, None)
    if rival is not None and _apart(pairs, agree, start, rival):
        n_rival = int((~agree & (pairs.squared(rival) < _CHI2_3_999)).sum())
        if n_rival >= max(_RIVAL * agree.sum(), 0.5 * MIN_COMMON):
            return NoMap(
                f"two places of the other map explain the landmarks alike: {agree.sum()} "
                f"agree with one, {n_rival} with another (repeated structure)"
            )
    found = _refined(pairs, start, pairs.once(start, agree), rng)
    if isinstance(found, NoMap):
        return found
    reason = _doubt(found, junior.map, limit, options)
    return NoMap(reason) if reason else found


class _Pairs:
    """Pairs of landmarks with the errors that they have, own and shared."""

    def __init__(self, senior: Side, junior: Side, common: Common) -> None:
        self._senior, self._junior, self.common = senior, junior, common
        self.a = senior.map.points_world[common.senior]
        self.b = junior.map.points_world[common.junior]
        self._of_a = senior.sure.marginal()[common.senior]
        self._of_b = junior.sure.marginal()[common.junior]
        alike_m = _ALIKE_PX * _metres_per_px(senior.map)[common.senior]
        self._alike = np.where(common.certain, 0.0, alike_m**2)

    def squared(self, at: Similarity) -> Array:
        """Return (M,) squared Mahalanobis distances between the landmarks of each pair."""
        turn = at.scale * at.rotation
        apart = self.a - at.apply(self.b)
        covariance = self._of_a + turn @ self._of_b @ turn.T
        covariance += self._alike[:, None, None] * np.eye(3)
        return squared_distances(apart, covariance)

    def once(self, at: Similarity, agree: Mask) -> NDArray[np.intp]:
        """Return pairs that agree, each landmark in its best one only."""
        rows = np.flatnonzero(agree)
        rows = rows[np.argsort(self.squared(at)[rows], kind="stable")]
        for side in (self.common.senior, self.common.junior):
            rows = rows[np.sort(np.unique(side[rows], return_index=True)[1])]
        return np.sort(rows)

    def weights(self, rows: NDArray[np.intp]) -> Array:
        """Return (M,) what each pair's distance is worth."""
        total = np.trace(self._of_a[rows] + self._of_b[rows], axis1=1, axis2=2)
        return np.asarray(1.0 / (total + 3.0 * self._alike[rows] + 1e-12))

    def covariance(self, rows: NDArray[np.intp], at: Similarity) -> Array:
        """Return (3M, 3M) the joint covariance of the distances of some pairs, m^2."""
        turn = at.scale * at.rotation
        senior, junior = self._senior.sure, self._junior.sure
        one, other = self.common.senior[rows], self.common.junior[rows]
        out = np.zeros((3 * len(rows), 3 * len(rows)))
        for sure, lever in (
            (senior, senior.landmark_lever[one]),
            (junior, turn @ junior.landmark_lever[other]),
        ):
            flat = lever.reshape(3 * len(rows), -1)
            out += flat @ sure.keyframe_covariance @ flat.T
        own = senior.landmark_covariance[one] + turn @ junior.landmark_covariance[other] @ turn.T
        own = own + self._alike[rows][:, None, None] * np.eye(3)
        blocks = out.reshape(len(rows), 3, len(rows), 3)
        number = np.arange(len(rows))
        blocks[number, :, number, :] += own
        return out


def _metres_per_px(landmark_map: LandmarkMap) -> Array:
    """Return (N,) how far apart two points at a landmark are that an image shows a pixel apart."""
    out = np.full(len(landmark_map.points_world), np.inf)
    for i, keyframe in enumerate(landmark_map.keyframes):
        centre = (keyframe.world_from_body @ keyframe.body_from_cam).translation
        away = np.linalg.norm(landmark_map.points_world - centre, axis=1)
        size = away / keyframe.camera.focal_px
        out = np.where(landmark_map.seen[:, i], np.minimum(out, size), out)
    return out


def _searched(
    pairs: _Pairs, usable: Mask, rng: np.random.Generator, first: Similarity | None
) -> Similarity | None:
    """Find the similarity that most of the usable pairs agree with; None where too few do.

    Args:
        pairs: all of them.
        usable: (M,) which count.
        rng: draws samples.
        first: tried before any of them.
    """
    rows = np.flatnonzero(usable)
    if len(rows) < MIN_COMMON // 2:
        return None
    if len(rows) > _SEARCHED:
        rows = np.sort(rng.choice(rows, _SEARCHED, replace=False))
    few = _Pairs(pairs._senior, pairs._junior, pairs.common.of(rows))
    best, most = None, MIN_COMMON // 2 - 1
    for n in range(_SAMPLES):
        three = rng.choice(len(rows), 3, replace=False)
        guess = first if n == 0 and first else Similarity.of_points(few.b[three], few.a[three])
        if guess is None or not 0.5 < guess.scale < 2.0:
            continue
        # Three landmarks are as far off as each is: what agrees with them roughly says better.
        close = few.squared(guess) < 4.0 * _CHI2_3_999
        if close.sum() <= most:
            continue
        for _ in range(3):
            index = np.flatnonzero(close)
            better = Similarity.of_points(few.b[index], few.a[index], few.weights(index))
            if better is None:
                break
            guess, close = better, few.squared(better) < _CHI2_3_999
            if close.sum() < 3:
                break
        if close.sum() > most:
            best, most = guess, int(close.sum())
        if most > 0.8 * len(rows):
            break
    return best


def _apart(pairs: _Pairs, agree: Mask, one: Similarity, other: Similarity) -> bool:
    """Whether two similarities put what agrees with the first one to different places."""
    points = pairs.b[agree]
    centre = points.mean(axis=0)
    size_m = one.scale * float(np.sqrt(((points - centre) ** 2).sum(axis=1).mean()))
    moved_m = float(np.linalg.norm(one.apply(centre) - other.apply(centre)))
    turned = angle_between(one.rotation, other.rotation)
    return moved_m > _APART * size_m or turned > _APART_RAD


def _refined(
    pairs: _Pairs, start: Similarity, rows: NDArray[np.intp], rng: np.random.Generator
) -> Aligned | NoMap:
    """Generalized least squares; what the others contradict is left out one round after another."""
    all_of_them = rows
    if len(rows) > _REFINED:
        rows = np.sort(rng.choice(rows, _REFINED, replace=False))
    found, covariance = start, np.zeros((7, 7))
    for _ in range(_ROUNDS):
        if len(rows) < MIN_COMMON:
            return NoMap(f"{len(rows)} common landmarks agree, {MIN_COMMON} needed")
        centre = pairs.b[rows].mean(axis=0)
        residual = (pairs.a[rows] - found.apply(pairs.b[rows])).ravel()
        slope = _slope(found, pairs.b[rows], centre)
        factor = cho_factor(pairs.covariance(rows, found))
        weighted = cho_solve(factor, slope)
        local = covariance_of(slope.T @ weighted, _SINGULAR)
        if local is None:
            return NoMap(f"{len(rows)} common landmarks do not fix how the maps stand")
        step = local @ weighted.T @ residual
        information = cho_solve(factor, np.eye(len(residual))) - weighted @ local @ weighted.T
        misfit, chi2 = _misfit(information, residual)
        to_world = _to_world(found, centre)
        found = found.moved(to_world @ step)
        # More than both maps' covariances explain is not explained by the similarity's either.
        spread = max(1.0, chi2 / (3 * len(rows) - 7))
        covariance = spread * to_world @ local @ to_world.T
        wrong = misfit > max(_CHI2_3_999, 0.25 * float(misfit.max()))
        if not wrong.any() and np.sqrt(step @ np.linalg.solve(local, step)) < 1e-2:
            break
        rows = rows[~wrong]
    agree = np.zeros(len(pairs.a), dtype=bool)
    agree[all_of_them] = pairs.squared(found)[all_of_them] < _CHI2_3_999
    return Aligned(found, covariance, pairs.common.of(agree))


def _misfit(information: Array, residual: Array) -> tuple[Array, float]:
    """Return (M,) how each pair misses what all others say of it, squared, and the whole."""
    n = len(residual) // 3
    number = np.arange(n)
    own = information.reshape(n, 3, n, 3)[number, :, number, :]
    pull = (information @ residual).reshape(n, 3)
    own = own + 1e-9 * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return squared_distances(pull, own), float(residual @ information @ residual)


def _slope(at: Similarity, points: Array, centre: Array) -> Array:
    """Return (3M, 7): how points move with a turn and a growth about a centre, and a shift."""
    turn = at.scale * at.rotation
    out = np.zeros((len(points), 3, 7))
    out[:, :, :3] = -turn @ skew(points - centre)
    out[:, :, 3:6] = np.eye(3)
    out[:, :, 6] = (points - centre) @ turn.T
    return out.reshape(-1, 7)


def _to_world(at: Similarity, centre: Array) -> Array:
    """Return (7, 7) from a perturbation about a centre to one about the origin (``moved``)."""
    turn = at.scale * at.rotation
    out = np.eye(7)
    out[3:6, :3] = turn @ skew(centre)
    out[3:6, 6] = -turn @ centre
    return out


def _doubt(found: Aligned, junior: LandmarkMap, limit_rad: float, options: MapOptions) -> str:
    """Say why a similarity is not to be believed; empty if it is."""
    n, at, covariance = len(found.common.senior), found.senior_from_junior, found.covariance
    if n < MIN_COMMON:
        return f"{n} common landmarks agree, {MIN_COMMON} needed"
    turn = worst_sigma(covariance[:3, :3])
    bodies = np.array([k.world_from_body.translation for k in junior.keyframes])
    middle = bodies.mean(axis=0)
    back = np.linalg.inv(_to_world(at, middle))
    sigma_m = worst_sigma((back @ covariance @ back.T)[3:6, 3:6])
    shown = junior.points_world[found.common.junior]
    depth_m = float(np.median(np.linalg.norm(shown - middle, axis=1)))
    if turn > _MAX_TURN_RAD or sigma_m > options.max_depth_error * at.scale * depth_m:
        return (
            f"{n} common landmarks, too close together or in a line, tell how the maps stand to "
            f"{np.rad2deg(turn):.1f} degrees and {sigma_m:.2f} m only"
        )
    vague = float(np.sqrt(covariance[6, 6]))
    if vague > options.max_depth_error:
        return f"{n} common landmarks tell the scale to {100 * vague:.0f} % only"
    off = abs(float(np.log(at.scale)))
    if off > min(_SCALE_SIGMAS * vague, float(np.log(_MOST_SCALE))):
        return (
            f"the scales contradict: a metre of the other map is {at.scale:.3f} m here, known to "
            f"{vague:.3f}"
        )
    tilt = float(np.arccos(np.clip(at.rotation[2, 2], -1.0, 1.0)))
    if tilt > limit_rad:
        return f"the verticals of the two maps are {np.rad2deg(tilt):.0f} degrees apart"
    return ""
