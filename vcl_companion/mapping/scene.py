"""Views registered one by one, and the landmarks they see (IV-C); no metres here yet."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.baseline import with_length
from vcl_companion.mapping.culling import LOOSE, decisive, fitting, placed
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.tracks import (
    ideal_of_pixels,
    join_tracks,
    pixels_of_tracks,
    slopes_of_ideal,
)
from vcl_companion.mapping.visibility import Edge
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    Views,
    adjust,
)
from vcl_companion.vision.essential import RelativePose
from vcl_companion.vision.resection import NotFound, ResectionOptions, Sightings, refine, search


@dataclass(frozen=True, eq=False)
class Scene:
    """Views registered so far, in an arbitrary frame and scale until the end.

    ``ideal`` is (N, V, 2), NaN where unseen or found wrong; ``slopes`` (N, V, 2, 2)
    goes with it; ``points`` (N, 3), NaN where not placed; ``cams`` world_from_cam
    of the registered views: lever arms are known in metres, and have no place
    here before the scale is known.
    """

    ideal: Array
    slopes: Array
    points: Array
    cams: dict[int, Pose]


def grown_from(
    drones: list[DroneView],
    pair: tuple[int, int],
    b_from_a: Pose,
    graph: dict[tuple[int, int], Edge],
    options: MapOptions,
) -> tuple[Scene, NDArray[np.intp]]:
    """Triangulate a seed pair, register view after view, adjust each time.

    Args:
        drones: all views.
        pair: the seed, two of them.
        b_from_a: the relative pose of its cameras.
        graph: what pairs of views have in common.
        options: thresholds.

    Returns:
        The scene with the views that could be registered, and the (N, V) tracks
        its landmarks are: feature of each view, -1 where unseen.
    """
    matches = {p: edge.matches for p, edge in graph.items()}
    tracks = join_tracks([len(d.pixels) for d in drones], matches)
    cameras = [d.camera for d in drones]
    ideal = ideal_of_pixels(pixels_of_tracks(tracks, [d.pixels for d in drones]), cameras)
    start = Scene(
        ideal,
        slopes_of_ideal(ideal, cameras),
        np.full((len(ideal), 3), np.nan),
        {pair[0]: Pose.identity(), pair[1]: b_from_a.inverse()},
    )
    scene = adjusted(start, options)
    while True:
        extended = register_next(drones, scene) or register_by_pair(drones, scene, graph, options)
        if extended is None:
            break
        scene = adjusted(extended, options)
    return scene, tracks


def adjusted(scene: Scene, options: MapOptions) -> Scene:
    """Triangulate all that registered views see, adjust, drop what does not fit; twice."""
    used = sorted(scene.cams)
    ideal = scene.ideal.copy()
    for limit_px in (LOOSE * options.max_error_px, options.max_error_px):
        points = placed([scene.cams[i] for i in used], ideal[:, used])
        scene = replace(scene, points=points, ideal=ideal)
        ideal, good = _culled(scene, limit_px, options)
        views = _held(views_of_scene(replace(scene, ideal=ideal), good))
        too_strong = decisive(views)
        if too_strong.any():
            good[np.flatnonzero(good)[too_strong]] = False
            views = _held(views_of_scene(replace(scene, ideal=ideal), good))
        adjusted, _ = adjust(views, BundleOptions())
        points = np.full_like(points, np.nan)
        points[good] = adjusted.points
        cams = dict(zip(used, adjusted.bodies, strict=True))
        scene = replace(scene, ideal=ideal, points=points, cams=cams)
    ideal, good = _culled(scene, options.max_error_px, options)
    points = np.where(good[:, None], scene.points, np.nan)
    return replace(scene, ideal=ideal, points=points)


def _held(views: Views) -> Views:
    """Hold one baseline: the scale is free until known distances fix it."""
    a, b = views.bodies[0], views.bodies[1]
    length = float(np.linalg.norm(a.translation - b.translation))
    return replace(views, distances=(Distance(0, 1, length, 1e-3 * length),))


def views_of_scene(scene: Scene, good: NDArray[np.bool_]) -> Views:
    """Return the registered views, by rising number, and the (N,) landmarks that are good."""
    used = sorted(scene.cams)
    return Views(
        bodies=tuple(scene.cams[i] for i in used),
        mountings=(Pose.identity(),) * len(used),
        slopes=scene.slopes[good][:, used],
        ideal=scene.ideal[good][:, used],
        points=scene.points[good],
        distances=(),
    )


def _culled(scene: Scene, limit_px: float, options: MapOptions) -> tuple[Array, NDArray[np.bool_]]:
    """Drop observations that miss; return (N, V, 2) the rest and (N,) landmarks still good."""
    used = sorted(scene.cams)
    views = views_of_scene(scene, np.ones(len(scene.points), dtype=bool))
    fits, good = fitting(views, limit_px, options)
    ideal = scene.ideal.copy()
    known = np.isfinite(scene.points[:, 0])
    for column, i in enumerate(used):
        # What no two registered views see is not placed yet, and not wrong either.
        ideal[known & ~fits[:, column], i] = np.nan
    return ideal, good


def register_next(drones: list[DroneView], scene: Scene) -> Scene | None:
    """Register the waiting view that sees most of what is placed; None when none can be."""
    known = np.isfinite(scene.points[:, 0])
    waiting = [i for i in range(len(drones)) if i not in scene.cams]
    common = {i: np.flatnonzero(known & np.isfinite(scene.ideal[:, i, 0])) for i in waiting}
    for i in sorted(waiting, key=lambda i: len(common[i]), reverse=True):
        index = common[i]
        sightings = Sightings(
            scene.ideal[index, i],
            scene.points[index],
            np.zeros((len(index), 3, 3)),
            drones[i].camera.focal_px,
            scene.slopes[index, i],
            Pose.identity(),
            1.0,
            np.zeros(len(index)),
        )
        wanted = ResectionOptions(min_inliers=20)
        start = search(sightings, wanted)
        if isinstance(start, NotFound):
            continue
        found = refine(start, sightings, wanted)
        if not isinstance(found, NotFound):
            return _registered(scene, i, found.world_from_body, index[~found.inliers])
    return None


def register_by_pair(
    drones: list[DroneView],
    scene: Scene,
    graph: dict[tuple[int, int], Edge],
    options: MapOptions,
) -> Scene | None:
    """Register the waiting view that shares most with a registered one; None when none can be."""
    known = np.isfinite(scene.points[:, 0])
    for i, k in sorted(graph, key=lambda p: len(graph[p].matches.a), reverse=True):
        chosen = graph[i, k].chosen
        if (i in scene.cams) == (k in scene.cams) or not isinstance(chosen, RelativePose):
            continue
        a, b, b_from_a = (
            (i, k, chosen.b_from_a) if i in scene.cams else (k, i, chosen.b_from_a.inverse())
        )
        index = np.flatnonzero(known & np.isfinite(scene.ideal[:, b, 0]))
        found = with_length(
            b_from_a,
            scene.cams[a].inverse().apply(scene.points[index]),
            scene.ideal[index, b],
            drones[b].camera,
            options,
        )
        if isinstance(found, NotFound):
            continue
        pose, agree = found
        return _registered(scene, b, scene.cams[a] @ pose.inverse(), index[~agree])
    return None


def _registered(scene: Scene, i: int, cam: Pose, wrong: NDArray[np.intp]) -> Scene:
    """Return the scene with a view in it, which does not see the landmarks that miss there."""
    ideal = scene.ideal.copy()
    ideal[wrong, i] = np.nan
    return replace(scene, ideal=ideal, cams={**scene.cams, i: cam})
