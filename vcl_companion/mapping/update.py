"""The map grows with the flight: new views on the old map, adjusted together (IV-G).

Common points carry scale and frame over. Old keyframes and landmarks stay; they
are adjusted with the new ones, held by the known distances and by the first
keyframe, and may move by no more than their covariance explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.continuity import broken_continuity, pruned
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.extension import Extension, ImageFeatures
from vcl_companion.mapping.growth import Growth
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.known_features import KeyframeLibrary, of_keyframes
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.patch_table import PyramidOf, decoded_pyramid
from vcl_companion.mapping.reconstruction import accepted
from vcl_companion.mapping.registration import Registration
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.mapping.visibility import MutualMatches
from vcl_companion.vision.features import Detector, FeatureOptions, Features, detect


def extend_map(
    old: LandmarkMap,
    parent: bytes,
    views: list[DroneView],
    options: MapOptions,
    seed: int = 0,
    features: FeatureOptions | None = None,
) -> LandmarkMap | NoMap:
    """Make the next revision of a map from new views.

    Args:
        old: the map so far.
        parent: its revision.
        views: new ones; several of one drone, of different instants, where it
            could not be registered by one.
        options: thresholds; its detectors are the views'.
        seed: of the robust searches.
        features: how the views' features were found, so that the old keyframes'
            are found alike.

    Returns:
        The old map with the views that could be registered and what they see,
        or why there is none.
    """
    chosen = features or FeatureOptions()

    def features_of(image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        return detect(decode_image(image_bytes, camera), detector, chosen)

    return extended(old, parent, views, features_of, options, seed)


def extended(
    old: LandmarkMap,
    parent: bytes,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int = 0,
    pyramid_of: PyramidOf = decoded_pyramid,
    sure: MapUncertainty | None = None,
    *,
    at_once: bool = False,
) -> LandmarkMap | NoMap:
    """Do what ``extend_map`` does, with any source of features, images and uncertainty.

    Views that say where they are are joined by patches. Those that do not, or are not
    there, are registered by their features, on what the others have made of the map:
    that takes many times as long, and ``at_once`` does without it.
    """
    known = {(k.drone_id, k.captured_at_ns) for k in old.keyframes}
    views = [v for v in views if (v.drone_id, v.captured_at_ns) not in known]
    if at_once:
        views = [v for v in views if v.world_from_body is not None]
    if not views:
        return NoMap("there is no view that the map does not have already")
    try:
        sure = sure or map_uncertainty(old, options.calibration_px)
        growth = _grown(
            old, sure, views, features_of, options, seed, pyramid_of, MutualMatches(), at_once
        )
    except ValueError as error:
        return NoMap(str(error))
    if isinstance(growth, NoMap):
        return growth
    reason = broken_continuity(old, sure, growth)
    if reason:
        return NoMap(reason)
    try:
        child = replace(
            growth.landmark_map, parent=parent, world=old.world_of(parent), joined=old.joined
        )
        made = pruned(child, len(old.keyframes), options)
    except ValueError as error:
        return NoMap(str(error))
    return accepted(made, options)


def _grown(
    old: LandmarkMap,
    sure: MapUncertainty,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    pyramid_of: PyramidOf,
    matches: MutualMatches,
    at_once: bool,
) -> Growth | NoMap:
    """Join views by patches, then the others by features on what came of it.

    Raises:
        ValueError: the map grown by patches is not fixed by what is seen.
    """
    growth: Growth | None = None
    if options.patches:
        views = _guessed(old, sure, views, features_of, options, seed, matches)
        growth = Extension(old, sure, views, features_of, pyramid_of, options).run()
    if at_once:
        return growth or NoMap("no view joins the map by its patches")
    if growth is None:
        return _by_features(old, sure, views, features_of, options, seed, pyramid_of, matches)
    # What they tell is of the landmarks of the old map, whose rows are others by now.
    waiting = [replace(v, told_px=None) for i, v in enumerate(views) if i not in growth.views]
    if not waiting:
        return growth
    known = growth.landmark_map
    late = _by_features(
        known,
        map_uncertainty(known, options.calibration_px),
        waiting,
        features_of,
        options,
        seed,
        pyramid_of,
        matches,
    )
    if isinstance(late, NoMap):
        return growth
    return replace(late, old=np.where(late.old >= 0, growth.old[late.old], -1))


def _guessed(
    old: LandmarkMap,
    sure: MapUncertainty,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    matches: MutualMatches,
) -> list[DroneView]:
    """Return the views, with poses by features for those that do not say where they are."""
    out = list(views)
    # The second detector costs as much again, and sees from farther apart.
    for detectors in dict.fromkeys((options.detectors[:1], options.detectors)):
        library = KeyframeLibrary(old, of_keyframes(features_of, detectors))
        for i, view in enumerate(out):
            if view.world_from_body is not None:
                continue
            try:
                found = tuple(features_of(view.image_bytes, view.camera, d) for d in detectors)
            except ValueError:
                continue
            shown = replace(view, features=found)
            pose = Registration(old, sure, [shown], library, options, seed, matches).pose_on_old()
            out[i] = replace(view, world_from_body=pose)
    return out


def _by_features(
    known: LandmarkMap,
    sure: MapUncertainty,
    waiting: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    pyramid_of: PyramidOf,
    matches: MutualMatches,
) -> Growth | NoMap:
    """Register views by their features; that done, by patches if they can be seen from there."""
    usable = []
    for view in waiting:
        try:
            found = tuple(features_of(view.image_bytes, view.camera, d) for d in options.detectors)
        except ValueError:
            continue
        usable.append(replace(view, features=found))
    if not usable:
        return NoMap("no frame has come that can be used")
    library = KeyframeLibrary(known, of_keyframes(features_of, options.detectors))
    late = Registration(known, sure, usable, library, options, seed, matches).run()
    if isinstance(late, NoMap) or not options.patches:
        return late
    found_at = late.landmark_map.keyframes[len(known.keyframes) :]
    guessed = [
        replace(usable[i], world_from_body=k.world_from_body)
        for i, k in zip(late.views, found_at, strict=True)
    ]
    sharper = Extension(known, sure, guessed, features_of, pyramid_of, options).run()
    return sharper if sharper and len(sharper.views) == len(late.views) else late
