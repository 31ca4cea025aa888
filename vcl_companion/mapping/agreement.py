"""Whether another map says the same of the world as the one in use: frame, scale, landmarks.

Maps come from peers, and one that is wrong would take every drone that flies on it along.
What both maps know, keyframes of the same drone and instant and the landmarks seen there,
must be where it was, as far as the one in use knows that itself; what the other one says of
its own accuracy does not count. Who made it has named what is compared, so that alone does not
suffice: one made from ours must have much of ours, and what a frame of our own shows must be
where it was (``moved_frame``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.information import squared_distances

# Squared Mahalanobis distance that one in 10 000 exceeds, in six and in three dimensions.
_CHI2_6, _CHI2_3 = 27.9, 21.1
# What is taken to be exact moves this much when a map is adjusted anew or rounded.
_LEAST_M, _LEAST_RAD = 0.02, 0.005
# However vague the map in use is: no keyframe or landmark moves by more than such a share of
# how far the scene is from the keyframes.
_MOST = 0.15
# Of keyframes and landmarks this share may be found wrong; more, and it is the other map that is.
_MAX_MOVED = 0.3
# Distances of the same two keyframes that differ by so many of both sigmas contradict each other.
_CONTRADICTS = 5.0
# So few landmarks in common tell nothing.
_FEWEST = 20
# A revision keeps at least such a share of the keyframes of the one that it was made from, and of
# the landmarks that those see. Extended, it loses no more keyframes than are new: three of four
# where it may have but four; merged, half of them. Of landmarks half stay at least, mostly all.
_LEAST_KEPT = 0.25


def contradiction(old: LandmarkMap, sure: MapUncertainty, new: LandmarkMap) -> str:
    """Say how a map contradicts the one in use; empty if it does not.

    Args:
        old: the map in use.
        sure: how well that is known.
        new: a map that is to take its place: a revision of it, of one before or after it, or
            any other.

    Returns:
        The reason. Maps without a keyframe in common do not contradict each other, unless one
        says that it was made from the other, which is not known here.
    """
    places = _in_common(old, new)
    if not places:
        return ""
    reach_m = _MOST * _scene_m(old)
    return (
        _moved_keyframes(old, sure, new, places, reach_m)
        or _moved_distances(old, new, places)
        or _moved_landmarks(old, sure, new, places, reach_m)
    )


def broken_descent(old: LandmarkMap, new: LandmarkMap) -> str:
    """Say what a map lacks that says it was made from the one in use; empty if it has enough."""
    lacking = too_little_of(old, new)
    return f"made from ours, {lacking}" if lacking else ""


def too_little_of(old: LandmarkMap, new: LandmarkMap) -> str:
    """Say how little of the one in use a map has in it; empty if that is enough to compare."""
    places = _in_common(old, new)
    if len(places) < _LEAST_KEPT * len(old.keyframes):
        return f"it has {len(places)} of its {len(old.keyframes)} keyframes"
    n_before = int(old.seen[:, [before for before, _ in places]].any(axis=1).sum())
    n_kept = len(_same_landmarks(old, new, places)[0])
    if n_kept < _LEAST_KEPT * n_before:
        return f"it has {n_kept} of the {n_before} landmarks in its keyframes"
    return ""


def moved_frame(
    known: Pose, covariance: Array, found: Pose, noise: Array, landmark_map: LandmarkMap
) -> str:
    """Say how a frame of ours contradicts a map that it was found on; empty if it does not.

    Args:
        known: where we were by the map in use, carried to the other one's world.
        covariance: (6, 6) local, of that.
        found: where we were by the other map.
        noise: (6, 6) local, of the finding alone: what the map says of itself does not count.
        landmark_map: the map in use.
    """
    reach_m = _MOST * _scene_m(landmark_map)
    if worst_sigma(noise[:3, :3]) > reach_m:
        return ""
    metres = _moved(known, covariance + noise, found, reach_m)
    return "" if metres is None else f"a frame of ours was taken {metres:.2f} m off by it"


def moved_to(landmark_map: LandmarkMap, other_from_world: Similarity) -> LandmarkMap:
    """Return a map as it is in another world, to be compared with one of that."""
    return replace(
        landmark_map,
        keyframes=tuple(
            replace(k, world_from_body=other_from_world.of_pose(k.world_from_body))
            for k in landmark_map.keyframes
        ),
        points_world=other_from_world.apply(landmark_map.points_world),
        distances=tuple(
            replace(d, distance_m=other_from_world.scale * d.distance_m)
            for d in landmark_map.distances
        ),
    )


def _in_common(old: LandmarkMap, new: LandmarkMap) -> list[tuple[int, int]]:
    """Return the places, in the old and in the new map, of the keyframes of both."""
    where = {(k.drone_id, k.captured_at_ns): i for i, k in enumerate(old.keyframes)}
    names = [(k.drone_id, k.captured_at_ns) for k in new.keyframes]
    return [(where[name], i) for i, name in enumerate(names) if name in where]


def _scene_m(landmark_map: LandmarkMap) -> float:
    """Return how far the landmarks are from the keyframes that see them, m."""
    away = landmark_map.ranges_m()[landmark_map.seen]
    return float(np.median(away)) if len(away) else 0.0


def _moved_keyframes(
    old: LandmarkMap,
    sure: MapUncertainty,
    new: LandmarkMap,
    places: list[tuple[int, int]],
    reach_m: float,
) -> str:
    moved_m = []
    for before, after in places:
        own = slice(6 * before, 6 * before + 6)
        there = new.keyframes[after].world_from_body
        metres = _moved(
            old.keyframes[before].world_from_body,
            sure.keyframe_covariance[own, own],
            there,
            reach_m,
        )
        if metres is not None:
            moved_m.append(metres)
    if len(moved_m) <= _MAX_MOVED * len(places):
        return ""
    return f"{len(moved_m)} of {len(places)} known keyframes moved by {np.median(moved_m):.2f} m"


def _moved(known: Pose, covariance: Array, other: Pose, reach_m: float) -> float | None:
    """Return by how much a pose has moved, m; None if not by more than may be."""
    step = known.local(other)
    floor = np.diag([_LEAST_M**2] * 3 + [_LEAST_RAD**2] * 3)
    squared = float(step @ np.linalg.solve(covariance + floor, step))
    metres = float(np.linalg.norm(step[:3]))
    return metres if squared > _CHI2_6 or metres > max(reach_m, _LEAST_M) else None


def _moved_distances(old: LandmarkMap, new: LandmarkMap, places: list[tuple[int, int]]) -> str:
    after = dict(places)
    known = {
        frozenset((after[d.keyframe_a], after[d.keyframe_b])): d
        for d in old.distances
        if d.keyframe_a in after and d.keyframe_b in after
    }
    for d in new.distances:
        before = known.get(frozenset((d.keyframe_a, d.keyframe_b)))
        if before is None:
            continue
        off_m = abs(d.distance_m - before.distance_m)
        # Its own sigma is what the other one says: no more than ours is believed.
        if off_m > _CONTRADICTS * before.sigma_m + _LEAST_M:
            return f"a distance of {before.distance_m:.2f} m is {d.distance_m:.2f} m there"
    return ""


def _moved_landmarks(
    old: LandmarkMap,
    sure: MapUncertainty,
    new: LandmarkMap,
    places: list[tuple[int, int]],
    reach_m: float,
) -> str:
    """Compare the landmarks that were seen at the same pixel of the same keyframe."""
    then, now = _same_landmarks(old, new, places)
    if len(then) < _FEWEST:
        return ""
    moved = new.points_world[now] - old.points_world[then]
    covariance = sure.marginal()[then] + _LEAST_M**2 * np.eye(3)
    squared = squared_distances(moved, covariance)
    metres = np.linalg.norm(moved, axis=1)
    # A landmark far behind the scene is known as badly as it is far.
    reaches_m = max(reach_m, _LEAST_M) + np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    far = (squared > _CHI2_3) | (metres > reaches_m)
    if far.mean() <= _MAX_MOVED:
        return ""
    return f"{far.sum()} of {len(far)} known landmarks moved by {np.median(metres[far]):.2f} m"


def _same_landmarks(
    old: LandmarkMap, new: LandmarkMap, places: list[tuple[int, int]]
) -> tuple[Index, Index]:
    """Return which landmarks of both are the same: seen where the other was, in one keyframe."""
    then, now = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for before, after in places:
        there, here = np.flatnonzero(old.seen[:, before]), np.flatnonzero(new.seen[:, after])
        _, i, j = np.intersect1d(
            _as_one(old.observed_px[there, before]),
            _as_one(new.observed_px[here, after]),
            return_indices=True,
        )
        then.append(there[i])
        now.append(here[j])
    landmarks, first = np.unique(np.concatenate(then), return_index=True)
    return landmarks, np.concatenate(now)[first]


def _as_one(pixels: Array) -> NDArray[np.complex128]:
    """Return (N,) numbers that are equal where (N, 2) pixels are."""
    return np.ascontiguousarray(pixels).view(np.complex128)[:, 0]
