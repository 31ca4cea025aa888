"""What an extended map owes to the old one: the same world, and a bounded size (IV-G)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import Mask
from vcl_companion.mapping.growth import Growth
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap
from vcl_companion.mapping.options import MOST_PIXELS, MapOptions
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.vision.information import squared_distances

# Squared Mahalanobis distance in three dimensions that one in 10 000 exceeds.
_CHI2_3_9999 = 21.1
# Of the old landmarks this share may be found wrong; more, and it is the update that is.
_MAX_MOVED = 0.1
# An encoded map has to pass as one blob of 8 MiB, its table of pixels included.
MAX_IMAGE_BYTES = 6 * 1024 * 1024
# Landmarks that two keyframes share if they are to hold each other.
_LINK = 40
# What carries frame and scale is worth so many times what it shows.
_CARRYING = 2.0
# The newest keyframes of a map stay, so large a share of what it may have: what comes next hangs
# on them, and takes its scale from what they share. By what each alone shows, all would stay that
# were there first, and of where the drones are by now none but the last round's.
_NEWEST = 0.5
# A distance that is to carry the scale on is at least so long, and not known better than this.
_LEAST_DISTANCE_M, _FINEST = 0.1, 1e-5


def broken_continuity(old: LandmarkMap, sure: MapUncertainty, growth: Growth) -> str:
    """Say how old landmarks moved by more than their covariance explains; empty if they did not."""
    stays = growth.old >= 0
    before = growth.old[stays]
    moved = growth.landmark_map.points_world[stays] - old.points_world[before]
    covariance = sure.marginal()[before]
    squared = squared_distances(moved, covariance)
    far = squared > _CHI2_3_9999
    if len(before) < 0.5 * len(old.points_world):
        return f"{len(before)} of {len(old.points_world)} old landmarks fit the new views"
    if far.mean() > _MAX_MOVED:
        metres = float(np.median(np.linalg.norm(moved[far], axis=1)))
        return (
            f"{far.sum()} of {len(far)} old landmarks would move by {metres:.2f} m, "
            "more than their covariance explains"
        )
    return ""


def pruned(landmark_map: LandmarkMap, n_old: int, options: MapOptions) -> LandmarkMap:
    """Drop keyframes and landmarks that contribute least until the map is within its bounds.

    New keyframes stay, and the newest of the old. Where the first one goes, or the last known
    distance, the next one takes its place, as well known as it is by then: what is too old to
    matter is summed up in that (marginalized).

    Args:
        landmark_map: the extended map.
        n_old: how many of its keyframes are old, they come first.
        options: the bounds.

    Raises:
        ValueError: the map's observations do not fix it.
    """
    whole, left = landmark_map, list(range(len(landmark_map.keyframes)))
    while n_old > 0:
        keyframes = landmark_map.keyframes
        size = sum(len(k.image_bytes) for k in keyframes)
        fits = size <= MAX_IMAGE_BYTES and landmark_map.n_pixels <= MOST_PIXELS
        if len(keyframes) <= options.max_keyframes and fits:
            break
        seen = landmark_map.seen
        # A landmark that few others see is mostly this keyframe's own.
        worth = (seen / np.maximum(seen.sum(axis=1, keepdims=True) - 1, 1)).sum(axis=0)
        carrying = {0} | {k for d in landmark_map.distances for k in (d.keyframe_a, d.keyframe_b)}
        worth[list(carrying)] *= _CARRYING
        n_older = len(keyframes) - int(_NEWEST * options.max_keyframes)
        k = _least_missed(landmark_map, worth[: max(min(n_old, n_older), 1)])
        landmark_map = _without(landmark_map, k)
        del left[k]
        n_old -= 1
    if left[0] != 0 or (whole.distances and not landmark_map.distances):
        landmark_map = _anchored_anew(
            landmark_map, whole, map_uncertainty(whole, options.calibration_px), left
        )
    excess = len(landmark_map.points_world) - options.max_landmarks
    if excess > 0:
        # The longest tracks stay; of equal ones the older.
        order = np.argsort(-landmark_map.seen.sum(axis=1), kind="stable")
        keep = np.zeros(len(order), dtype=bool)
        keep[order[: options.max_landmarks]] = True
        landmark_map = landmark_map.of_landmarks(keep)
    return landmark_map


def newest_part(whole: LandmarkMap, sure: MapUncertainty, n_keyframes: int) -> LandmarkMap:
    """Return what the newest keyframes of a map show: a map in the same frame, of the same scale.

    Args:
        whole: the map.
        sure: how well it is known.
        n_keyframes: how many of its keyframes the part is to have.

    Raises:
        ValueError: the map's observations do not fix it, or the part's own do not.
    """
    n_gone = len(whole.keyframes) - n_keyframes
    part = whole
    for _ in range(n_gone):
        part = _without(part, 0)
    if n_gone > 0:
        part = _anchored_anew(part, whole, sure, list(range(n_gone, len(whole.keyframes))))
        map_uncertainty(part)
    return part


def _least_missed(landmark_map: LandmarkMap, worth: Array) -> int:
    """Return the keyframe worth least of those without which the others hang together as before.

    Args:
        landmark_map: all of it.
        worth: of the keyframes that may go; they come first.
    """
    seen = landmark_map.seen.astype(np.int64)
    linked = seen.T @ seen >= _LINK
    n_before = _n_parts(linked)
    for k in np.argsort(worth, kind="stable"):
        if _n_parts(_less(linked, int(k))) <= n_before:
            return int(k)
    return 0


def _n_parts(linked: Mask) -> int:
    """Return into how many parts keyframes fall, and by how many more without any one of them.

    Two parts that a single keyframe joins may each have a scale of its own.
    """
    count = _n_components(linked)
    return count + sum(max(_n_components(_less(linked, k)) - count, 0) for k in range(len(linked)))


def _n_components(linked: Mask) -> int:
    """Return into how many parts a graph falls; scipy's takes ten times as long for a small one."""
    reached = linked | np.eye(len(linked), dtype=bool)
    while True:
        further = reached @ reached
        if (further == reached).all():
            # Of each part the first one reaches nobody before itself.
            return int((reached.argmax(axis=1) == np.arange(len(reached))).sum())
        reached = further


def _less(linked: Mask, k: int) -> Mask:
    return np.asarray(np.delete(np.delete(linked, k, axis=0), k, axis=1))


def _anchored_anew(
    landmark_map: LandmarkMap, whole: LandmarkMap, sure: MapUncertainty, left: list[int]
) -> LandmarkMap:
    """Return a map with frame and scale as they were in the whole that this is left of."""
    covariance = sure.keyframe_covariance
    anchor = covariance[6 * left[0] :, 6 * left[0] :][:6, :6]
    distances = landmark_map.distances
    if whole.distances and not distances:
        bodies = [k.world_from_body for k in landmark_map.keyframes]
        known = [
            _known_distance(n, bodies, covariance, left)
            for n in range(1, len(bodies))
            if np.linalg.norm(bodies[n].translation - bodies[0].translation) > _LEAST_DISTANCE_M
        ]
        if not known:
            raise ValueError("the map's observations do not fix it")
        distances = (min(known, key=lambda d: d.sigma_m / d.distance_m),)
    return replace(landmark_map, anchor_covariance=0.5 * (anchor + anchor.T), distances=distances)


def _known_distance(
    n: int, bodies: list[Pose], covariance: Array, left: list[int]
) -> KnownDistance:
    """Return how far a keyframe is from the first one, and how well that is known."""
    line = bodies[n].translation - bodies[0].translation
    distance_m = float(np.linalg.norm(line))
    change = np.zeros(len(covariance))
    for sign, place, body in ((-1.0, left[0], bodies[0]), (1.0, left[n], bodies[n])):
        change[6 * place : 6 * place + 3] = sign * body.rotation.T @ line / distance_m
    sigma_m = math.sqrt(max(float(change @ covariance @ change), 0.0))
    return KnownDistance(0, n, distance_m, max(sigma_m, _FINEST * distance_m))


def _without(landmark_map: LandmarkMap, k: int) -> LandmarkMap:
    """Return the map without a keyframe, and without what it alone had seen with one other."""
    shorter = replace(
        landmark_map,
        keyframes=landmark_map.keyframes[:k] + landmark_map.keyframes[k + 1 :],
        observed_px=np.delete(landmark_map.observed_px, k, axis=1),
        distances=tuple(
            KnownDistance(
                d.keyframe_a - (d.keyframe_a > k),
                d.keyframe_b - (d.keyframe_b > k),
                d.distance_m,
                d.sigma_m,
            )
            for d in landmark_map.distances
            if k not in (d.keyframe_a, d.keyframe_b)
        ),
    )
    return shorter.of_landmarks(shorter.seen.sum(axis=1) >= 2)
