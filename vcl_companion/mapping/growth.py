"""A map with new views in it: tracks over old keyframes and new views, adjusted together (IV-G)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import (
    LOOSE,
    Mask,
    decisive,
    fitting,
    of_landmarks,
    of_observations,
    placed,
)
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.joining import Joined
from vcl_companion.mapping.known_features import Index, KeyframeLibrary
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.tracks import (
    PairMatches,
    ideal_of_pixels,
    join_tracks,
    slopes_of_ideal,
)
from vcl_companion.mapping.uncertainty import distances_of
from vcl_companion.vision.bundle import BundleOptions, Views, adjust
from vcl_companion.vision.essential import sampson_px

# More of them move keyframes by less than half a millimetre.
_FIRST_STEPS, _LAST_STEPS = 6, 12


@dataclass(frozen=True, eq=False)
class Growth:
    """An old map and the views that have joined it.

    Attributes:
        landmark_map: keyframes and landmarks adjusted together; the old keyframes
            first, then the views that joined, in the order of ``views``.
        views: which of the new views these are.
        old: (N,) which landmark of the old map each one is, -1 for new ones.
        rows: for each view its features' landmarks, -1 for none.
    """

    landmark_map: LandmarkMap
    views: tuple[int, ...]
    old: Index
    rows: dict[int, Index]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Matches made so far: of keyframes (``a``) with views, and of views with each other."""

    with_keyframes: dict[tuple[int, int], PairMatches]
    with_views: dict[tuple[int, int], PairMatches]


def grown(
    old: LandmarkMap,
    library: KeyframeLibrary,
    views: list[DroneView],
    joined: dict[int, Joined],
    pairs: Pairs,
    options: MapOptions,
) -> Growth:
    """Triangulate what is new, adjust old and new together, drop what does not fit.

    Args:
        old: the map that the views are registered on.
        library: the features of its keyframes.
        views: all new views.
        joined: those registered, with their links to the old landmarks.
        pairs: all matches; only those that the poses explain are used.
        options: thresholds.
    """
    chosen = tuple(sorted(joined))
    cameras = [k.camera for k in old.keyframes] + [views[i].camera for i in chosen]
    observed, rows = _observed(old, library, views, joined, pairs, options)
    ideal = ideal_of_pixels(observed, cameras)
    n_old = len(old.points_world)
    estimate = Views(
        bodies=tuple(k.world_from_body for k in old.keyframes)
        + tuple(joined[i].world_from_body for i in chosen),
        mountings=tuple(k.body_from_cam for k in old.keyframes)
        + tuple(views[i].body_from_cam for i in chosen),
        slopes=slopes_of_ideal(ideal, cameras),
        ideal=ideal,
        points=np.vstack([old.points_world, np.full((len(ideal) - n_old, 3), np.nan)]),
        distances=distances_of(old.distances),
    )
    noise_px, good = old.pixel_noise_px, np.zeros(len(ideal), dtype=bool)
    for factor, steps in ((LOOSE, _FIRST_STEPS), (1.0, _LAST_STEPS)):
        estimate, good, noise_px = _adjusted(
            estimate, n_old, factor * options.max_error_px, steps, options
        )
    fits, again = fitting(estimate, options.max_error_px, options)
    good &= again
    keyframes = tuple(
        replace(k, world_from_body=body)
        for k, body in zip(old.keyframes, estimate.bodies, strict=False)
    ) + tuple(
        keyframe_of(views[i], estimate.bodies[len(old.keyframes) + n]) for n, i in enumerate(chosen)
    )
    number = np.where(good, np.cumsum(good) - 1, -1)
    return Growth(
        LandmarkMap(
            keyframes=keyframes,
            points_world=estimate.points[good],
            observed_px=np.where(fits[good][..., None], observed[good], np.nan),
            pixel_noise_px=noise_px,
            detectors=tuple(dict.fromkeys(old.detectors + options.detectors)),
            distances=old.distances,
            parent=old.parent,
            anchor_covariance=old.anchor_covariance,
            world=old.world,
            joined=old.joined,
        ),
        chosen,
        np.where(np.arange(len(good)) < n_old, np.arange(len(good)), -1)[good],
        {i: np.where(row >= 0, number[row], -1) for i, row in rows.items()},
    )


def keyframe_of(view: DroneView, world_from_body: Pose) -> Keyframe:
    """Return what a view is as a part of a map."""
    return Keyframe(
        view.drone_id,
        view.captured_at_ns,
        world_from_body,
        view.body_from_cam,
        view.camera,
        view.image_bytes,
    )


def view_of(keyframe: Keyframe) -> DroneView:
    """Return a keyframe as the view that it was, where the map puts it, without its features."""
    return DroneView(
        keyframe.drone_id,
        keyframe.captured_at_ns,
        keyframe.camera,
        keyframe.body_from_cam,
        None,
        keyframe.image_bytes,
        (),
        keyframe.world_from_body,
    )


def _adjusted(
    estimate: Views, n_old: int, limit_px: float, steps: int, options: MapOptions
) -> tuple[Views, Mask, float]:
    """Place new landmarks, drop what misses by more than the limit, adjust the rest."""
    cams = [b @ m for b, m in zip(estimate.bodies, estimate.mountings, strict=True)]
    points = estimate.points.copy()
    points[n_old:] = placed(cams, estimate.ideal[n_old:])
    estimate = replace(estimate, points=points)
    fits, good = fitting(estimate, limit_px, options)
    estimate = of_observations(estimate, fits)
    good[np.flatnonzero(good)[decisive(of_landmarks(estimate, good))]] = False
    adjusted, noise_px = adjust(of_landmarks(estimate, good), BundleOptions(max_iterations=steps))
    points[good] = adjusted.points
    return replace(estimate, bodies=adjusted.bodies, points=points), good, noise_px


def _observed(
    old: LandmarkMap,
    library: KeyframeLibrary,
    views: list[DroneView],
    joined: dict[int, Joined],
    pairs: Pairs,
    options: MapOptions,
) -> tuple[Array, dict[int, Index]]:
    """Return (N, V, 2) pixels, the old landmarks first, and the row of each view's features."""
    chosen, read = sorted(joined), library.read
    column = {i: 1 + len(read) + n for n, i in enumerate(chosen)}
    of_keyframe = {k: 1 + n for n, k in enumerate(read)}
    linked = {i: np.zeros(len(views[i].pixels), dtype=bool) for i in chosen}
    edges: dict[tuple[int, int], PairMatches] = {}
    for i in chosen:
        edges[0, column[i]] = joined[i].links
        linked[i][joined[i].links.b] = True
    limit_px = LOOSE * options.max_error_px
    for (k, i), m in pairs.with_keyframes.items():
        if i in joined:
            keyframe = old.keyframes[k]
            world_from_a = keyframe.world_from_body @ keyframe.body_from_cam
            # What is a landmark already was linked to it, or not, by the registration.
            m = _of_pair(m, read[k].landmark[m.a] < 0)
            a_px, b_px = read[k].pixels[m.a], views[i].pixels[m.b]
            meets = _meets(world_from_a, keyframe.camera, a_px, views[i], joined[i], b_px)
            edges[of_keyframe[k], column[i]] = _of_pair(m, meets < limit_px)
    for (i, k), m in pairs.with_views.items():
        if i in joined and k in joined:
            world_from_a = joined[i].world_from_body @ views[i].body_from_cam
            m = _of_pair(m, ~(linked[i][m.a] & linked[k][m.b]))
            a_px, b_px = views[i].pixels[m.a], views[k].pixels[m.b]
            meets = _meets(world_from_a, views[i].camera, a_px, views[k], joined[k], b_px)
            edges[column[i], column[k]] = _of_pair(m, meets < limit_px)
    sizes = [len(old.points_world), *(len(f.pixels) for f in read.values())]
    tracks = join_tracks([*sizes, *(len(views[i].pixels) for i in chosen)], edges)
    return _table(tracks, old, library, views, linked, column, of_keyframe)


def _table(
    tracks: Index,
    old: LandmarkMap,
    library: KeyframeLibrary,
    views: list[DroneView],
    linked: dict[int, Mask],
    column: dict[int, int],
    of_keyframe: dict[int, int],
) -> tuple[Array, dict[int, Index]]:
    """Write tracks into the old map's table of pixels, new ones below."""
    contradicts = np.zeros(len(tracks), dtype=bool)
    for i, c in column.items():
        # Linked to an old landmark and yet without one: it was claimed by two.
        contradicts |= (tracks[:, c] >= 0) & linked[i][tracks[:, c]] & (tracks[:, 0] < 0)
    tracks = tracks[~contradicts]
    n_old, n_keyframes = len(old.points_world), len(old.keyframes)
    fresh = tracks[:, 0] < 0
    row = np.where(fresh, n_old + np.cumsum(fresh) - 1, tracks[:, 0])
    observed = np.full((n_old + int(fresh.sum()), n_keyframes + len(column), 2), np.nan)
    observed[:n_old, :n_keyframes] = old.observed_px
    for k, c in of_keyframe.items():
        seen = np.flatnonzero((tracks[:, c] >= 0) & ~np.isfinite(observed[row, k, 0]))
        observed[row[seen], k] = library.of(k).pixels[tracks[seen, c]]
    rows = {}
    for n, (i, c) in enumerate(column.items()):
        seen = np.flatnonzero(tracks[:, c] >= 0)
        observed[row[seen], n_keyframes + n] = views[i].pixels[tracks[seen, c]]
        rows[i] = np.full(len(views[i].pixels), -1, dtype=np.intp)
        rows[i][tracks[seen, c]] = row[seen]
    return observed, rows


def _meets(
    world_from_a: Pose, camera_a: Camera, a_px: Array, view: DroneView, at: Joined, b_px: Array
) -> Array:
    """Return (M,) how far matches are from meeting, px, between a camera and a joined view."""
    world_from_b = at.world_from_body @ view.body_from_cam
    b_from_a = world_from_b.inverse() @ world_from_a
    if not np.linalg.norm(b_from_a.translation) > 0.0:
        return np.full(len(a_px), np.inf)
    ideal_a, ideal_b = camera_a.ideal_from_pixels(a_px), view.camera.ideal_from_pixels(b_px)
    focal_px = 0.5 * (camera_a.focal_px + view.camera.focal_px)
    distance = np.abs(sampson_px(b_from_a, ideal_a, ideal_b, focal_px))
    return np.where(np.isfinite(distance), distance, np.inf)


def _of_pair(matches: PairMatches, chosen: Mask) -> PairMatches:
    return PairMatches(matches.a[chosen], matches.b[chosen])
