"""The first map, from one image of each drone (IV-C).

A seed pair with the most common features gives a relative pose; the other
drones join one by one; everything is adjusted together, scaled by the known
distance and placed in the world by the leader's attitude.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.scale import metric
from vcl_companion.mapping.scene import grown_from
from vcl_companion.mapping.sharpening import sharpened
from vcl_companion.mapping.thinning import thinned
from vcl_companion.mapping.tracks import pixels_of_tracks
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.visibility import Edge, visibility_graph
from vcl_companion.vision.essential import RelativePose

__all__ = ["MapOptions", "NoMap", "accepted", "lacks", "reconstruct"]


def lacks(attitudes: Mapping[int, Array | None], leader: int) -> str:
    """Say what a first map lacks, before anything is looked at; empty for nothing.

    Args:
        attitudes: of the drones that an image has come of, None where their autopilots say none.
        leader: system id of the drone whose body is the world's origin.
    """
    if leader not in attitudes:
        return f"the leader, drone {leader}, has sent no image"
    if attitudes[leader] is None:
        return f"the autopilot of the leader, drone {leader}, sends no attitude"
    if len(attitudes) < 2:
        return "a first map needs the images of two drones, one has come"
    return ""


def reconstruct(
    drones: list[DroneView],
    leader: int,
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
    seed: int = 0,
) -> LandmarkMap | NoMap:
    """Build the first map.

    Args:
        drones: one view each, taken at about the same time.
        leader: system id of the drone whose body is the world's origin.
        distances_m: (drone, drone, metres) between their bodies.
        options: thresholds.
        seed: of the robust searches.

    Returns:
        A metric map whose first keyframe is the leader's, or the reason why not.
        A drone that overlaps nobody is left out of it.
    """
    lacking = lacks({d.drone_id: d.ned_from_body for d in drones}, leader)
    if lacking:
        return NoMap(lacking)
    drones = sorted(drones, key=lambda d: d.drone_id != leader)
    graph = visibility_graph(drones, options, seed)
    reasons: list[str] = []
    for pair in sorted(graph, key=lambda p: len(graph[p].matches.a), reverse=True):
        chosen = graph[pair].chosen
        if isinstance(chosen, RelativePose):
            built = _build(drones, pair, chosen, graph, distances_m, options)
            if isinstance(built, LandmarkMap):
                return built
            reasons.append(built.reason)
        else:
            reasons.append(chosen.reason)
    return NoMap(reasons[0])


def _build(
    drones: list[DroneView],
    pair: tuple[int, int],
    chosen: RelativePose,
    graph: dict[tuple[int, int], Edge],
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
) -> LandmarkMap | NoMap:
    """Grow a scene from the seed pair, make it metric."""
    scene, tracks = grown_from(drones, pair, chosen.b_from_a, graph, options)
    observed = pixels_of_tracks(tracks, [d.pixels for d in drones])
    made = metric(drones, scene, observed, distances_m, options)
    if isinstance(made, NoMap):
        return made
    # Patches from far apart may not resemble each other enough: then the features have to do.
    if options.patches:
        sharp = thinned(sharpened(made, options), options.landmarks_per_cell)
        better = accepted(sharp, options)
        if isinstance(better, LandmarkMap):
            return better
    return accepted(made, options)


def accepted(landmark_map: LandmarkMap, options: MapOptions) -> LandmarkMap | NoMap:
    """Refuse a map too small or too vague to fly on."""
    n = len(landmark_map.points_world)
    if n < options.min_landmarks:
        return NoMap(f"{n} landmarks could be placed, {options.min_landmarks} needed")
    try:
        sure = map_uncertainty(landmark_map, options.calibration_px)
    except ValueError as error:
        return NoMap(str(error))
    away = landmark_map.ranges_m()
    away[~landmark_map.seen] = np.inf
    nearest = away.argmin(axis=1)
    covariance = sure.seen_from(landmark_map.keyframes, nearest)
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    vague = float(np.median(sigma / away[np.arange(n), nearest]))
    if vague > options.max_depth_error:
        return NoMap(
            f"landmarks are known to {100 * vague:.0f} % of their distance, "
            f"{100 * options.max_depth_error:.0f} % needed: the drones are too close together"
        )
    return landmark_map
