"""The first map, from one image of each drone (IV-C).

A seed pair with the most common features gives a relative pose; the other
drones join one by one; everything is adjusted together, scaled by the known
distance and placed in the world by the leader's attitude.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, log_so3
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.leverage import leverages
from vcl_companion.mapping.tracks import (
    PairMatches,
    ideal_of_pixels,
    join_tracks,
    pixels_of_tracks,
    slopes_of_ideal,
)
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    Views,
    adjust,
    reprojection_residuals,
)
from vcl_companion.vision.essential import EssentialOptions, RelativePose, relative_poses
from vcl_companion.vision.features import Detector
from vcl_companion.vision.matching import MatchOptions, match_mutual
from vcl_companion.vision.resection import NotFound, ResectionOptions, Sightings, refine, search
from vcl_companion.vision.triangulation import ray_angles, triangulate

# A landmark that decides more than this of the poses is left out.
_MAX_LEVERAGE = 0.25


@dataclass(frozen=True)
class MapOptions:
    """How a first map is made, and when it is good enough to fly on.

    Attributes:
        detectors: features that the map is made of; SIFT makes the better geometry
            from far apart, and those of the localization must be among them.
        keyframe_quality: WebP quality of exchanged images, 1 to 100.
        min_landmarks: fewer are refused.
        min_angle_deg: landmarks seen under a smaller angle are left out.
        max_error_px: observations that miss by more are left out.
        attitude_sigma_deg: how far two autopilots' relative attitude may be off, 1 sigma.
        distance_sigma_m: how well the known distances are known, 1 sigma.
        max_depth_error: relative depth error, 1 sigma, median over the landmarks,
            above which the map is refused.
        member_wait_s: how long a first map waits for members that are not there yet.
        gather_timeout_s: how long it waits for the frames of those that are.
        directory: where revisions are kept; empty for nowhere.
    """

    detectors: tuple[Detector, ...] = ("akaze", "sift")
    keyframe_quality: int = 80
    min_landmarks: int = 60
    min_angle_deg: float = 1.0
    max_error_px: float = 2.5
    attitude_sigma_deg: float = 4.0
    distance_sigma_m: float = 0.01
    max_depth_error: float = 0.1
    member_wait_s: float = 10.0
    gather_timeout_s: float = 20.0
    directory: str = ""

    def __post_init__(self) -> None:
        if not 1 <= self.keyframe_quality <= 100:
            raise ValueError(f"keyframe_quality must lie in 1..100, got {self.keyframe_quality}")
        if self.min_landmarks < 20:
            raise ValueError(f"min_landmarks must be at least 20, got {self.min_landmarks}")
        for name in (
            "min_angle_deg",
            "max_error_px",
            "attitude_sigma_deg",
            "distance_sigma_m",
            "max_depth_error",
            "member_wait_s",
            "gather_timeout_s",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True)
class NoMap:
    """No map can be made of these views, and why."""

    reason: str


@dataclass(frozen=True, eq=False)
class _Scene:
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


@dataclass(frozen=True, eq=False)
class _Edge:
    """What two views have in common: matches that agree, and the relative pose if it is sure."""

    matches: PairMatches
    chosen: RelativePose | NoMap


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
    first = next((i for i, d in enumerate(drones) if d.drone_id == leader), None)
    if first is None:
        return NoMap(f"the leader, drone {leader}, has sent no image")
    drones = [drones[first], *drones[:first], *drones[first + 1 :]]
    if drones[0].ned_from_body is None:
        return NoMap(f"the autopilot of the leader, drone {leader}, sends no attitude")
    if len(drones) < 2:
        return NoMap("a first map needs the images of two drones, one has come")
    graph = _visibility_graph(drones, options, seed)
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


def choose_hypothesis(
    hypotheses: list[RelativePose], rotation_guess: Array | None, sigma_rad: float
) -> RelativePose | NoMap:
    """Choose between planar twins: by cost over all matches and by the measured attitudes.

    Args:
        hypotheses: all that explain the matches.
        rotation_guess: (3, 3) b_from_a by the autopilots, or None.
        sigma_rad: how far that guess may be off, 1 sigma.

    Returns:
        The one that explains matches and attitudes best, or a refusal when a
        clearly different one explains them as well (within 3 sigma).
    """

    def total(h: RelativePose) -> float:
        if rotation_guess is None:
            return h.cost
        angle = float(np.linalg.norm(log_so3(rotation_guess.T @ h.b_from_a.rotation)))
        return h.cost + (angle / sigma_rad) ** 2

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
    turn = float(np.linalg.norm(log_so3(one.rotation.T @ other.rotation)))
    cosine = float(np.clip(one.translation @ other.translation, -1.0, 1.0))
    return float(np.rad2deg(turn)), float(np.rad2deg(np.arccos(cosine)))


def _visibility_graph(
    drones: list[DroneView], options: MapOptions, seed: int
) -> dict[tuple[int, int], _Edge]:
    """Match every pair of images and keep what one relative pose explains."""
    return {
        (i, k): _edge(drones[i], drones[k], options, seed)
        for i, k in combinations(range(len(drones)), 2)
    }


def _edge(a: DroneView, b: DroneView, options: MapOptions, seed: int) -> _Edge:
    """Find the relative pose of two drones' cameras, or say why not."""
    matches = _match(a, b)
    names = f"drones {a.drone_id} and {b.drone_id}"
    guess = None
    if a.ned_from_body is not None and b.ned_from_body is not None:
        ned_from_a = a.ned_from_body @ a.body_from_cam.rotation
        guess = (b.ned_from_body @ b.body_from_cam.rotation).T @ ned_from_a
    hypotheses = relative_poses(
        a.camera.ideal_from_pixels(a.pixels[matches.a]),
        b.camera.ideal_from_pixels(b.pixels[matches.b]),
        0.5 * (a.camera.focal_px + b.camera.focal_px),
        guess,
        EssentialOptions(),
        seed,
    )
    none = PairMatches(matches.a[:0], matches.b[:0])
    if not hypotheses:
        return _Edge(none, NoMap(f"{names} see too little in common ({len(matches.a)} matches)"))
    chosen = choose_hypothesis(hypotheses, guess, np.deg2rad(options.attitude_sigma_deg))
    cheapest = chosen if isinstance(chosen, RelativePose) else hypotheses[0]
    agreed = PairMatches(matches.a[cheapest.inliers], matches.b[cheapest.inliers])
    if isinstance(chosen, NoMap):
        return _Edge(agreed, NoMap(f"{names}: {chosen.reason}"))
    if len(agreed.a) < options.min_landmarks:
        few = f"{len(agreed.a)} matches agree, {options.min_landmarks} needed"
        return _Edge(agreed, NoMap(f"{names} see too little in common ({few})"))
    return _Edge(agreed, chosen)


def _match(a: DroneView, b: DroneView) -> PairMatches:
    """Match two images, detector by detector."""
    rows, columns = [], []
    start_a = start_b = 0
    for features_a, features_b in zip(a.features, b.features, strict=True):
        i, k = match_mutual(features_a, features_b, MatchOptions())
        rows.append(i + start_a)
        columns.append(k + start_b)
        start_a += len(features_a)
        start_b += len(features_b)
    return PairMatches(np.concatenate(rows), np.concatenate(columns))


def _build(
    drones: list[DroneView],
    pair: tuple[int, int],
    chosen: RelativePose,
    graph: dict[tuple[int, int], _Edge],
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
) -> LandmarkMap | NoMap:
    """Triangulate the seed pair, register the others, adjust, make it metric."""
    tracks = join_tracks([len(d.pixels) for d in drones], {p: e.matches for p, e in graph.items()})
    observed = pixels_of_tracks(tracks, [d.pixels for d in drones])
    ideal = ideal_of_pixels(observed, [d.camera for d in drones])
    scene = _Scene(
        ideal,
        slopes_of_ideal(ideal, [d.camera for d in drones]),
        np.full((len(ideal), 3), np.nan),
        {pair[0]: Pose.identity(), pair[1]: chosen.b_from_a.inverse()},
    )
    scene = _adjusted(drones, scene, options)
    while True:
        extended = _register_next(drones, scene, options)
        if extended is None:
            break
        scene = _adjusted(drones, extended, options)
    return _metric(drones, scene, observed, distances_m, options)


def _adjusted(drones: list[DroneView], scene: _Scene, options: MapOptions) -> _Scene:
    """Triangulate all that registered views see, adjust, drop what does not fit; twice."""
    used = sorted(scene.cams)
    ideal = scene.ideal.copy()
    for limit_px in (3.0 * options.max_error_px, options.max_error_px):
        points = triangulate([scene.cams[i] for i in used], ideal[:, used])
        scene = replace(scene, points=points, ideal=ideal)
        ideal, good = _culled(drones, scene, limit_px, options)
        views = _held(_views(drones, replace(scene, ideal=ideal), good))
        decisive = leverages(views) > _MAX_LEVERAGE
        if decisive.any():
            good[np.flatnonzero(good)[decisive]] = False
            views = _held(_views(drones, replace(scene, ideal=ideal), good))
        adjusted, _ = adjust(views, BundleOptions())
        points = np.full_like(points, np.nan)
        points[good] = adjusted.points
        cams = dict(zip(used, adjusted.bodies, strict=True))
        scene = replace(scene, ideal=ideal, points=points, cams=cams)
    ideal, good = _culled(drones, scene, options.max_error_px, options)
    points = np.where(good[:, None], scene.points, np.nan)
    return replace(scene, ideal=ideal, points=points)


def _held(views: Views) -> Views:
    """Hold one baseline: the scale is free until known distances fix it."""
    a, b = views.bodies[0], views.bodies[1]
    length = float(np.linalg.norm(a.translation - b.translation))
    return replace(views, distances=(Distance(0, 1, length, 1e-3 * length),))


def _views(drones: list[DroneView], scene: _Scene, good: NDArray[np.bool_]) -> Views:
    used = sorted(scene.cams)
    return Views(
        bodies=tuple(scene.cams[i] for i in used),
        mountings=(Pose.identity(),) * len(used),
        slopes=scene.slopes[good][:, used],
        ideal=scene.ideal[good][:, used],
        points=scene.points[good],
        distances=(),
    )


def _culled(
    drones: list[DroneView], scene: _Scene, limit_px: float, options: MapOptions
) -> tuple[Array, NDArray[np.bool_]]:
    """Drop observations that miss; return (N, V, 2) the rest and (N,) landmarks still good."""
    used = sorted(scene.cams)
    views = _views(drones, scene, np.ones(len(scene.points), dtype=bool))
    error = np.linalg.norm(reprojection_residuals(views), axis=2)
    ideal = scene.ideal.copy()
    fits = error < limit_px
    placed = np.isfinite(scene.points[:, 0])
    for column, i in enumerate(used):
        # What no two registered views see is not placed yet, and not wrong either.
        ideal[placed & ~fits[:, column], i] = np.nan
    cams = [scene.cams[i] for i in used]
    angle = ray_angles(cams, np.nan_to_num(scene.points), fits)
    good = (fits.sum(axis=1) >= 2) & (angle > np.deg2rad(options.min_angle_deg))
    return ideal, np.asarray(good)


def _register_next(drones: list[DroneView], scene: _Scene, options: MapOptions) -> _Scene | None:
    """Register the waiting view that sees most of what is placed; None when none can be."""
    placed = np.isfinite(scene.points[:, 0])
    waiting = [i for i in range(len(drones)) if i not in scene.cams]
    common = {i: np.flatnonzero(placed & np.isfinite(scene.ideal[:, i, 0])) for i in waiting}
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
            ideal = scene.ideal.copy()
            ideal[index[~found.inliers], i] = np.nan
            return replace(scene, ideal=ideal, cams={**scene.cams, i: found.world_from_body})
    return None


def _metric(
    drones: list[DroneView],
    scene: _Scene,
    observed: Array,
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
) -> LandmarkMap | NoMap:
    """Scale by the known distances, place in the leader's world, adjust once more."""
    if 0 not in scene.cams:
        return NoMap(f"the leader, drone {drones[0].drone_id}, sees too little of what others see")
    used = sorted(scene.cams)
    ids = [drones[i].drone_id for i in used]
    known = [
        Distance(ids.index(a), ids.index(b), length, options.distance_sigma_m)
        for a, b, length in distances_m
        if a in ids and b in ids
    ]
    if not known:
        return NoMap(
            f"no known distance between drones that see the same (drones {ids} do): "
            "the scale is unknown"
        )
    if drones[0].ned_from_body is None:
        raise ValueError("the leader's attitude is checked before")
    cams = [scene.cams[i] for i in used]
    # Of the cameras instead of the bodies: the adjustment settles the lever arms' share.
    ratios = [
        d.distance_m / float(np.linalg.norm(cams[d.a].translation - cams[d.b].translation))
        for d in known
    ]
    scale = float(np.median(ratios))
    leader_cam = Pose(drones[0].ned_from_body, np.zeros(3)) @ drones[0].body_from_cam
    world_from_scene = leader_cam @ cams[0].inverse()
    placed = np.isfinite(scene.points[:, 0])
    views = replace(
        _views(drones, scene, placed),
        bodies=tuple(
            Pose(
                world_from_scene.rotation @ cam.rotation,
                _scaled(world_from_scene, scale, cam.translation, cams[0]),
            )
            @ drones[i].body_from_cam.inverse()
            for i, cam in zip(used, cams, strict=True)
        ),
        mountings=tuple(drones[i].body_from_cam for i in used),
        points=_scaled(world_from_scene, scale, scene.points[placed], cams[0]),
        distances=tuple(known),
    )
    views, noise_px = adjust(views, BundleOptions())
    seen = np.isfinite(views.ideal[:, :, :1])
    landmark_map = LandmarkMap(
        keyframes=tuple(
            Keyframe(d.drone_id, d.captured_at_ns, body, d.body_from_cam, d.camera, d.image_bytes)
            for d, body in zip((drones[i] for i in used), views.bodies, strict=True)
        ),
        points_world=views.points,
        observed_px=np.where(seen, observed[placed][:, used], np.nan),
        pixel_noise_px=noise_px,
        detectors=options.detectors,
        distances=tuple(KnownDistance(d.a, d.b, d.distance_m, d.sigma_m) for d in known),
        parent=b"",
    )
    return _accepted(landmark_map, options)


def _scaled(world_from_scene: Pose, scale: float, points: Array, leader_cam: Pose) -> Array:
    """Scale about the leader's camera, then carry over to the world."""
    centre = leader_cam.translation
    return world_from_scene.apply(centre + scale * (points - centre))


def _accepted(landmark_map: LandmarkMap, options: MapOptions) -> LandmarkMap | NoMap:
    """Refuse a map too small or too vague to fly on."""
    n = len(landmark_map.points_world)
    if n < options.min_landmarks:
        return NoMap(f"{n} landmarks could be placed, {options.min_landmarks} needed")
    try:
        covariance = map_uncertainty(landmark_map).marginal()
    except ValueError as error:
        return NoMap(str(error))
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    depth = np.linalg.norm(landmark_map.points_world, axis=1)
    vague = float(np.median(sigma / depth))
    if vague > options.max_depth_error:
        return NoMap(
            f"landmarks are known to {100 * vague:.0f} % of their distance, "
            f"{100 * options.max_depth_error:.0f} % needed: the drones are too close together"
        )
    return landmark_map
