"""A new view placed on a map by the patches of its landmarks, near where it is guessed to be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.joining import believed
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.patch_table import PatchTable, Reference
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.patches import AlignRules
from vcl_companion.vision.resection import NotFound, ResectionOptions, Sightings, Undecided, refine

_MIN_INLIERS = 20
# So many landmarks fix a pose; all of them are looked for once that is known.
_WANTED = 500


@dataclass(frozen=True)
class _Look:
    """One look at a view: how patches are searched, and how exactly they are found."""

    rules: AlignRules
    noise_px: float = 0.15
    reach_px: float = 0.0
    level: int = 0


_RULES = AlignRules(max_iterations=15, forgives_noise=True)
_NEAR = (
    _Look(replace(_RULES, least_score=0.75, max_moved_px=3.0)),
    _Look(replace(_RULES, least_score=0.8, max_moved_px=1.5, settled_px=0.02)),
)
# A guess by features may be so far off; what is found at a quarter of the resolution leads on.
_FAR = (_Look(replace(_RULES, least_score=0.7), 1.0, 24.0, 2), *_NEAR)


@dataclass(frozen=True, eq=False)
class Placed:
    """A view on a map.

    Attributes:
        world_from_body: where it was taken.
        landmarks: (M,) of the map, that it shows.
        pixels: (M, 2) where, raw px.
    """

    world_from_body: Pose
    landmarks: Index
    pixels: Array


def references(
    known: LandmarkMap, camera: Camera, world_from_cam: Pose, relative_sigma: Array, n_wanted: int
) -> tuple[Index, Reference]:
    """Return which landmarks a view may show, each in the keyframe that saw it most alike.

    Args:
        known: the map.
        camera: of the view.
        world_from_cam: where it was taken.
        relative_sigma: (N,) of the landmarks' distances.
        n_wanted: at most so many, evenly of all there are.
    """
    pixels = camera.project(world_from_cam.inverse().apply(known.points_world))
    inside = np.flatnonzero(camera.shows(pixels, 6.0))
    points = known.points_world[inside]
    ray = points - world_from_cam.translation
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    best, unlike = np.full(len(inside), -1, dtype=np.intp), np.full(len(inside), np.inf)
    for k, keyframe in enumerate(known.keyframes):
        origin = (keyframe.world_from_body @ keyframe.body_from_cam).translation
        then = points - origin
        length = np.maximum(np.linalg.norm(then, axis=1), 1e-9)
        cosine = np.einsum("ni,ni->n", ray, then) / (distance * length)
        octaves = np.log2(length / distance * camera.focal_px / keyframe.camera.focal_px)
        # Seen twice as large costs as much as seen from 30 degrees aside; shrunk, half of that.
        score = np.arccos(np.clip(cosine, -1.0, 1.0)) + 0.5 * np.maximum(octaves, -0.5 * octaves)
        score = np.where(np.isfinite(known.observed_px[inside, k, 0]), score, np.inf)
        best, unlike = np.where(score < unlike, k, best), np.minimum(score, unlike)
    chosen = np.flatnonzero(best >= 0)
    if len(chosen) > n_wanted:
        chosen = chosen[np.linspace(0, len(chosen) - 1, n_wanted).astype(np.intp)]
    landmarks, view = inside[chosen], best[chosen]
    return landmarks, Reference(
        view, known.observed_px[landmarks, view], points[chosen], relative_sigma[landmarks]
    )


def place(
    view: DroneView,
    column: int,
    guess: Pose,
    known: LandmarkMap,
    sure: MapUncertainty,
    relative_sigma: Array,
    table: PatchTable,
    worlds_from_cams: list[Pose],
    options: MapOptions,
) -> Placed | NotFound:
    """Find a view's pose and the landmarks that it shows.

    Args:
        view: the view.
        column: of the view in the table; the map's keyframes come first.
        guess: where it was taken, to some pixels.
        known: the map.
        sure: how well it is known.
        relative_sigma: (N,) of the landmarks' distances.
        table: the images.
        worlds_from_cams: where those before the column were taken.
        options: how vague a pose may be.
    """
    n_known = len(worlds_from_cams)
    landmarks, reference = references(
        known, view.camera, guess @ view.body_from_cam, relative_sigma, _WANTED
    )
    result: Placed | NotFound = NotFound("no landmark of the map is in view")
    for looks in (_NEAR, _FAR):
        if len(landmarks) == 0 or isinstance(result, Placed):
            break
        pose = guess
        for look in looks:
            poses = [*worlds_from_cams, *[pose @ view.body_from_cam] * (table.n_views - n_known)]
            found = table.found(reference, poses, [column], look.rules, look.reach_px, look.level)
            at = found.pixels[:, column]
            is_near = looks is _NEAR
            result = _judged(
                view, pose, landmarks, at, known, sure, look.noise_px, options, is_near=is_near
            )
            if isinstance(result, NotFound):
                break
            pose = result.world_from_body
    return result


def _judged(
    view: DroneView,
    pose: Pose,
    landmarks: Index,
    found: Array,
    known: LandmarkMap,
    sure: MapUncertainty,
    noise_px: float,
    options: MapOptions,
    *,
    is_near: bool,
) -> Placed | NotFound:
    """Return where (M, 2) pixels of landmarks, NaN where not found, put a view.

    ``is_near``: these were looked for within a few pixels of where the view says that it was
    taken. Then none of them can be far off, not even one that decides the pose.
    """
    hit = np.flatnonzero(np.isfinite(found[:, 0]))
    links = PairMatches(landmarks[hit], np.arange(len(hit), dtype=np.intp))
    sightings = _sightings(view, links.a, found[hit], known, sure, noise_px)
    refined = refine(pose, sightings, ResectionOptions(min_inliers=_MIN_INLIERS))
    if is_near and isinstance(refined, Undecided):
        refined = refined.found
    checked = believed(view, links, refined, known, sure, options)
    if isinstance(checked, NotFound):
        return checked
    return Placed(checked.world_from_body, checked.links.a, found[hit][checked.links.b])


def _sightings(
    view: DroneView,
    landmarks: Index,
    pixels: Array,
    known: LandmarkMap,
    sure: MapUncertainty,
    noise_px: float,
) -> Sightings:
    ideal = view.camera.ideal_from_pixels(pixels)
    return Sightings(
        ideal,
        known.points_world[landmarks],
        sure.for_matching(landmarks),
        view.camera.focal_px,
        view.camera.pixel_slopes(ideal),
        view.body_from_cam,
        max(known.pixel_noise_px, noise_px),
        np.zeros(len(landmarks)),
    )
