"""One new view registered on a map by common points, each as uncertain as it is (IV-G)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.known_features import Index, KeyframeLibrary
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.features import Features, joined_features
from vcl_companion.vision.matching import MatchOptions, match_guided
from vcl_companion.vision.resection import (
    NotFound,
    Resection,
    ResectionOptions,
    Sightings,
    refine,
    search,
    somewhere_alike,
)

_MIN_INLIERS = 20
_GUIDED_PX = 8.0
# New views see landmarks from elsewhere: their pixels are never taken for surer than this.
_NOISE_PX = 0.5
# A pose is good enough to triangulate by up to this error of its direction, 1 sigma.
_MAX_TURN_RAD = np.deg2rad(2.0)
# Autopilots disagree about the heading by more than about the vertical.
_HEADING_FACTOR = 2.0


@dataclass(frozen=True, eq=False)
class Joined:
    """A view with its place in the map.

    Attributes:
        world_from_body: where it was taken.
        links: landmarks (``a``) and the features of the view (``b``) that they are.
    """

    world_from_body: Pose
    links: PairMatches


def join(
    view: DroneView,
    links: PairMatches,
    known: LandmarkMap,
    sure: MapUncertainty,
    options: MapOptions,
) -> Joined | NotFound:
    """Find a view's pose from features that may be landmarks, wrong ones among them.

    Args:
        view: the view.
        links: landmarks (``a``) and features (``b``).
        known: the map.
        sure: how well its landmarks are known; the pose inherits their errors.
        options: the attitude's sigma, and how vague a pose may be.

    Returns:
        The pose and the links that agree, or why there is none. A pose that
        the landmarks do not fix to ``max_depth_error`` of their distance is none.
    """
    wanted = ResectionOptions(min_inliers=_MIN_INLIERS)
    sightings = sightings_of(view, links, known, sure)
    start = search(sightings, wanted)
    if isinstance(start, NotFound):
        return start
    return believed(view, links, refine(start, sightings, wanted), known, sure, options)


def join_nearby(
    view: DroneView,
    guess: Pose,
    library: KeyframeLibrary,
    known: LandmarkMap,
    sure: MapUncertainty,
    options: MapOptions,
) -> Joined | NotFound:
    """Match a view again where a first pose puts the landmarks, and refine; see ``join``."""
    cam_from_world = (guess @ view.body_from_cam).inverse()
    predicted = view.camera.project(cam_from_world.apply(known.points_world))
    size = np.array([view.camera.width_px, view.camera.height_px])
    with np.errstate(invalid="ignore"):
        inside = ((predicted > -_GUIDED_PX) & (predicted < size + _GUIDED_PX)).all(axis=1)
    predicted[~inside] = np.nan
    found, landmarks, start = [], [], 0
    for d, features in enumerate(view.features):
        entries, owner = _entries(library, d)
        if len(owner):
            i, j = match_guided(features, entries, owner, predicted, _GUIDED_PX, MatchOptions())
            found.append(i + start)
            landmarks.append(j)
        start += len(features)
    none = np.zeros(0, np.intp)
    links = PairMatches(np.concatenate([none, *landmarks]), np.concatenate([none, *found]))
    result = refine(
        guess, sightings_of(view, links, known, sure), ResectionOptions(min_inliers=_MIN_INLIERS)
    )
    if isinstance(result, Resection):
        result = somewhere_alike(result, _GUIDED_PX) or result
    return believed(view, links, result, known, sure, options)


def sightings_of(
    view: DroneView, links: PairMatches, known: LandmarkMap, sure: MapUncertainty
) -> Sightings:
    """Return what a view sees of a map's landmarks, each with its whole covariance."""
    ideal = view.camera.ideal_from_pixels(view.pixels[links.b])
    return Sightings(
        ideal,
        known.points_world[links.a],
        sure.for_matching(links.a),
        view.camera.focal_px,
        view.camera.pixel_slopes(ideal),
        view.body_from_cam,
        max(known.pixel_noise_px, _NOISE_PX),
        np.zeros(len(links.a)),
    )


def contradiction(view: DroneView, world_from_body: Pose, options: MapOptions) -> str:
    """Say how a pose contradicts the autopilot's attitude; empty when it does not."""
    if view.ned_from_body is None:
        return ""
    sigma = np.deg2rad(options.attitude_sigma_deg)
    turn = 0.0
    if view.has_heading:
        turn = angle_between(world_from_body.rotation, view.ned_from_body)
    vertical = float(world_from_body.rotation[2] @ view.ned_from_body[2])
    tilt = float(np.arccos(np.clip(vertical, -1.0, 1.0)))
    if tilt > 3.0 * sigma or turn > 3.0 * _HEADING_FACTOR * sigma:
        return (
            f"disagrees with its autopilot's attitude by {np.rad2deg(max(tilt, turn)):.0f} degrees"
        )
    return ""


def believed(
    view: DroneView,
    links: PairMatches,
    found: Resection | NotFound,
    known: LandmarkMap,
    sure: MapUncertainty,
    options: MapOptions,
) -> Joined | NotFound:
    """Return a view at a pose found, unless that is too vague or contradicts its attitude."""
    if isinstance(found, NotFound):
        return found
    kept = PairMatches(links.a[found.inliers], links.b[found.inliers])
    covariance = _covariance(found, kept.a, sure)
    centre = (found.world_from_body @ view.body_from_cam).translation
    depth = float(np.median(np.linalg.norm(known.points_world[kept.a] - centre, axis=1)))
    sigma_m = worst_sigma(covariance[:3, :3])
    turn = worst_sigma(covariance[3:, 3:])
    if sigma_m > options.max_depth_error * depth or turn > _MAX_TURN_RAD:
        return NotFound(
            f"known to {sigma_m:.1f} m and {np.rad2deg(turn):.1f} degrees only, {depth:.0f} m away"
        )
    reason = contradiction(view, found.world_from_body, options)
    return NotFound(reason) if reason else Joined(found.world_from_body, kept)


def _covariance(found: Resection, landmarks: Index, sure: MapUncertainty) -> Array:
    """Return (6, 6): pixel noise, the landmarks' own errors, and those they share."""
    by_landmark = -found.gain @ found.jacobian_points
    own = np.einsum(
        "mij,mjk,mlk->il", by_landmark, sure.landmark_covariance[landmarks], by_landmark
    )
    lever = np.einsum("mij,mjk->ik", by_landmark, sure.landmark_lever[landmarks])
    return np.asarray(found.noise_covariance + own + lever @ sure.keyframe_covariance @ lever.T)


def _entries(library: KeyframeLibrary, d: int) -> tuple[Features, Index]:
    """Return the descriptors of one detector that the keyframes read so far have of landmarks."""
    parts, owners = [], []
    for known in library.read.values():
        start = sum(len(f) for f in known.features[:d])
        owner = known.landmark[start : start + len(known.features[d])]
        index = np.flatnonzero(owner >= 0)
        parts.append(known.features[d].subset(index))
        owners.append(owner[index])
    return joined_features(parts), np.concatenate(owners)
