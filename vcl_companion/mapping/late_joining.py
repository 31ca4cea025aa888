"""A drone that no single view of its own can register joins with several at once (IV-C, IV-G).

Its views make a scene of their own, of unknown scale. A similarity places that
scene in the map by the landmarks that all its views share with it together,
each weighed by its own uncertainty.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.joining import Joined, contradiction, sightings_of
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.scene import Scene, grown_from
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.mapping.visibility import visibility_graph
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.essential import RelativePose
from vcl_companion.vision.information import covariance_of
from vcl_companion.vision.resection import Sightings

_MIN_COMMON = 20
_SAMPLES = 400
_SEARCH_PX = 12.0
# 99.9 % of a two-dimensional Gaussian.
_CHI2_2_999 = 13.8
_SINGULAR = 1e-10


def join_together(
    views: list[DroneView],
    links: list[PairMatches],
    matched: dict[tuple[int, int], PairMatches],
    known: LandmarkMap,
    sure: MapUncertainty,
    options: MapOptions,
    seed: int,
) -> dict[int, Joined] | NoMap:
    """Register several views of one drone jointly.

    Args:
        views: of different instants.
        links: for each, landmarks (``a``) and its features (``b``) that they may be.
        matched: matches between the views.
        known: the map.
        sure: how well its landmarks are known.
        options: thresholds.
        seed: of the robust searches.

    Returns:
        The views that joined, by their position in ``views``, or why none did.
    """
    graph = visibility_graph(views, options, seed, matched)
    reason = "its views have too little in common"
    for pair in sorted(graph, key=lambda p: len(graph[p].matches.a), reverse=True):
        chosen = graph[pair].chosen
        if not isinstance(chosen, RelativePose):
            continue
        scene, tracks = grown_from(views, pair, chosen.b_from_a, graph, options)
        placed = _placed(views, links, scene, tracks, known, sure, options, seed)
        if not isinstance(placed, NoMap):
            return placed
        reason = placed.reason
    return NoMap(reason)


def _placed(
    views: list[DroneView],
    links: list[PairMatches],
    scene: Scene,
    tracks: NDArray[np.intp],
    known: LandmarkMap,
    sure: MapUncertainty,
    options: MapOptions,
    seed: int,
) -> dict[int, Joined] | NoMap:
    """Place a scene of several views in the map."""
    used, links = sorted(scene.cams), list(links)
    seen = {}
    for i in used:
        # A wrong match may be with a pixel that the lens cannot produce, and spoil all sums.
        usable = sightings_of(views[i], links[i], known, sure).usable()
        links[i] = PairMatches(links[i].a[usable], links[i].b[usable])
        seen[i] = sightings_of(views[i], links[i], known, sure)
    start = _searched(views, links, scene, tracks, seen, known, options, seed)
    if start is None:
        return NoMap(f"its {len(used)} views share no place with the map that all agree on")
    found, inliers, covariance = _refined(start, scene, seen)
    n_common = sum(int(inliers[i].sum()) for i in used)
    if n_common < _MIN_COMMON or covariance is None:
        return NoMap(
            f"its {len(used)} views together see {n_common} landmarks that agree, "
            f"{_MIN_COMMON} needed"
        )
    vague = float(np.sqrt(covariance[6, 6]))
    if vague > options.max_depth_error:
        return NoMap(f"its {len(used)} views together know their scale to {100 * vague:.0f} % only")
    joined = {}
    for i in used:
        body = found.of_pose(scene.cams[i]) @ views[i].body_from_cam.inverse()
        reason = contradiction(views[i], body, options)
        if reason:
            return NoMap(reason)
        kept = PairMatches(links[i].a[inliers[i]], links[i].b[inliers[i]])
        joined[i] = Joined(body, kept)
    return joined


def _searched(
    views: list[DroneView],
    links: list[PairMatches],
    scene: Scene,
    tracks: NDArray[np.intp],
    seen: dict[int, Sightings],
    known: LandmarkMap,
    options: MapOptions,
    seed: int,
) -> Similarity | None:
    """Find the similarity that most links agree with, from triples of common points."""
    common = []
    for i in sorted(scene.cams):
        row_of = np.full(len(views[i].pixels), -1, dtype=np.intp)
        has = np.flatnonzero(tracks[:, i] >= 0)
        row_of[tracks[has, i]] = has
        row = row_of[links[i].b]
        ok = (row >= 0) & np.isfinite(scene.points[row, 0])
        common.append(np.stack([row[ok], links[i].a[ok]], axis=1))
    pairs = np.unique(np.concatenate(common), axis=0)
    if len(pairs) < 6:
        return None
    rng = np.random.default_rng(seed)
    in_scene, in_world = scene.points[pairs[:, 0]], known.points_world[pairs[:, 1]]
    best, most = None, 5
    for _ in range(_SAMPLES):
        three = rng.choice(len(pairs), 3, replace=False)
        guess = Similarity.of_points(in_scene[three], in_world[three])
        if guess is None or any(
            contradiction(views[i], guess.of_pose(cam) @ views[i].body_from_cam.inverse(), options)
            for i, cam in scene.cams.items()
        ):
            continue
        agree = sum(
            int((np.linalg.norm(_linearized(guess, scene, i, s)[0], axis=1) < _SEARCH_PX).sum())
            for i, s in seen.items()
        )
        if agree > most:
            best, most = guess, agree
    return best


def _refined(
    start: Similarity, scene: Scene, seen: dict[int, Sightings]
) -> tuple[Similarity, dict[int, NDArray[np.bool_]], Array | None]:
    """Gauss-Newton over all links, each weighed by its landmark's covariance as seen here.

    Returns:
        The similarity, which links agree, and its (7, 7) covariance; None where
        the links do not fix it.
    """
    found, inliers, covariance = start, {}, None
    for widening in (8.0, 4.0, 2.0, 1.0, 1.0, 1.0):
        normal, rhs = np.zeros((7, 7)), np.zeros(7)
        for i, sightings in seen.items():
            residual, by_similarity, by_point = _linearized(found, scene, i, sightings)
            spread = by_point @ sightings.point_covariances @ np.swapaxes(by_point, 1, 2)
            spread[:, [0, 1], [0, 1]] += sightings.noise_px**2
            information = np.linalg.inv(spread * widening**2)
            squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
            inliers[i] = np.asarray(squared < _CHI2_2_999)
            weighted = np.einsum("nki,nkl->nil", by_similarity, information)
            weighted *= (inliers[i] / (1.0 + squared / 4.0) ** 2)[:, None, None]
            normal += np.einsum("nik,nkj->ij", weighted, by_similarity)
            rhs -= np.einsum("nik,nk->i", weighted, residual)
        covariance = covariance_of(normal, _SINGULAR)
        if covariance is None:
            break
        found = found.moved(covariance @ rhs)
    return found, inliers, covariance


def _linearized(
    found: Similarity, scene: Scene, i: int, sightings: Sightings
) -> tuple[Array, Array, Array]:
    """Return (M, 2) residuals of one view, (M, 2, 7) by the similarity, (M, 2, 3) by the point."""
    world_from_cam = found.of_pose(scene.cams[i])
    residual, by_pose, by_point = linearized(
        world_from_cam, Pose.identity(), sightings.slopes, sightings.points, sightings.ideal
    )
    # How the camera moves, in its own axes, with each parameter of the similarity.
    centre = found.scale * scene.cams[i].translation
    skewed = np.cross(np.eye(3), centre)
    motion = np.zeros((6, 7))
    motion[:3, :3] = scene.cams[i].rotation.T @ skewed.T
    motion[3:, :3] = scene.cams[i].rotation.T
    motion[:3, 3:6] = world_from_cam.rotation.T
    motion[:3, 6] = scene.cams[i].rotation.T @ centre
    return residual, by_pose @ motion, by_point
