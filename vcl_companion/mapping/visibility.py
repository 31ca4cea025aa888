"""Which images see the same, and how the cameras stand to each other (IV-B, IV-C)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.relative_attitude import RelativeAttitude, relative_attitude
from vcl_companion.geometry.rotation import Array, angle_between
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.vision.essential import EssentialOptions, RelativePose, relative_poses
from vcl_companion.vision.features import Features
from vcl_companion.vision.matching import MatchOptions, match_mutual

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Edge:
    """What two views have in common: matches that agree, and the relative pose if it is sure."""

    matches: PairMatches
    chosen: RelativePose | NoMap


def visibility_graph(
    drones: list[DroneView],
    options: MapOptions,
    seed: int,
    matched: dict[tuple[int, int], PairMatches] | None = None,
) -> dict[tuple[int, int], Edge]:
    """Match every pair of images and keep what one relative pose explains.

    Args:
        drones: the views.
        options: thresholds.
        seed: of the robust searches.
        matched: pairs that are matched already; then only those are looked at.
    """
    if matched is None:
        matched = {
            (i, k): match_features(drones[i].features, drones[k].features)
            for i, k in combinations(range(len(drones)), 2)
        }
    return {(i, k): _edge(drones[i], drones[k], m, options, seed) for (i, k), m in matched.items()}


def choose_hypothesis(
    hypotheses: list[RelativePose], attitude: RelativeAttitude | None, sigma_rad: float
) -> RelativePose | NoMap:
    """Choose between planar twins: by cost over all matches and by the measured attitudes.

    Args:
        hypotheses: all that explain the matches.
        attitude: of the two by the autopilots, or None.
        sigma_rad: how far it may be off, 1 sigma.

    Returns:
        The one that explains matches and attitudes best, or a refusal when a
        clearly different one explains them as well (within 3 sigma).
    """

    def total(h: RelativePose) -> float:
        if attitude is None:
            return h.cost
        return h.cost + (attitude.off_rad(h.b_from_a.rotation) / sigma_rad) ** 2

    ranked = sorted(hypotheses, key=total)
    best = ranked[0]
    for other in ranked[1:]:
        turn_deg, shift_deg = _degrees_apart(best.b_from_a, other.b_from_a)
        # Twins of a short baseline are turned little, and yet displaced to elsewhere.
        if total(other) - total(best) < 9.0 and (turn_deg > 4.0 or shift_deg > 10.0):
            return NoMap(
                f"two relative poses {max(turn_deg, shift_deg):.0f} degrees apart explain the "
                "matches alike (a flat scene): let the drones see more relief"
            )
    return best


def _degrees_apart(one: Pose, other: Pose) -> tuple[float, float]:
    """Return the angle between two rotations and the one between two unit translations."""
    turn = angle_between(one.rotation, other.rotation)
    cosine = float(np.clip(one.translation @ other.translation, -1.0, 1.0))
    return float(np.rad2deg(turn)), float(np.rad2deg(np.arccos(cosine)))


def _edge(a: DroneView, b: DroneView, matches: PairMatches, options: MapOptions, seed: int) -> Edge:
    """Find the relative pose of two drones' cameras, or say why not."""
    names = f"drones {a.drone_id} and {b.drone_id}"
    attitude = relative_attitude(a, b)
    hypotheses = relative_poses(
        a.camera.ideal_from_pixels(a.pixels[matches.a]),
        b.camera.ideal_from_pixels(b.pixels[matches.b]),
        0.5 * (a.camera.focal_px + b.camera.focal_px),
        None if attitude is None else attitude.b_from_a,
        EssentialOptions(),
        seed,
    )
    none = PairMatches(matches.a[:0], matches.b[:0])
    if not hypotheses:
        return Edge(none, NoMap(f"{names} see too little in common ({len(matches.a)} matches)"))
    chosen = choose_hypothesis(hypotheses, attitude, np.deg2rad(options.attitude_sigma_deg))
    cheapest = chosen if isinstance(chosen, RelativePose) else hypotheses[0]
    agreed = PairMatches(matches.a[cheapest.inliers], matches.b[cheapest.inliers])
    if isinstance(chosen, NoMap):
        return Edge(agreed, NoMap(f"{names}: {chosen.reason}"))
    if len(agreed.a) < options.min_landmarks:
        few = f"{len(agreed.a)} matches agree, {options.min_landmarks} needed"
        return Edge(agreed, NoMap(f"{names} see too little in common ({few})"))
    return Edge(agreed, chosen)


class MutualMatches:
    """Matches of images, detector by detector, found once however often a round asks for them."""

    def __init__(self) -> None:
        # With the pixels, so that what is known by its identity stays alive.
        self._known: dict[tuple[int, int], tuple[Array, Array, Index, Index]] = {}

    def of(self, a: Features, b: Features) -> tuple[Index, Index]:
        """Return what ``match_mutual`` does."""
        key = (id(a.pixels), id(b.pixels))
        if key not in self._known:
            self._known[key] = (a.pixels, b.pixels, *match_mutual(a, b, MatchOptions()))
        return self._known[key][2:]


def match_features(
    a: tuple[Features, ...], b: tuple[Features, ...], matches: MutualMatches | None = None
) -> PairMatches:
    """Match two images, detector by detector; indices count one detector after the other.

    Args:
        a: features of one image, a set for each detector.
        b: of the other.
        matches: remembers them; None for a pair that comes once.
    """
    matches = matches or MutualMatches()
    rows, columns = [], []
    start_a = start_b = 0
    for features_a, features_b in zip(a, b, strict=True):
        i, k = matches.of(features_a, features_b)
        rows.append(i + start_a)
        columns.append(k + start_b)
        start_a += len(features_a)
        start_b += len(features_b)
    return PairMatches(np.concatenate(rows), np.concatenate(columns))
