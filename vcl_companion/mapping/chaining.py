"""A view joined to a map by its relative pose with one keyframe, where few landmarks tell the rest.

Who looks from far aside shares features with the nearest keyframe, of which hardly any is a
landmark yet: what is mapped is what the drones before saw together (IV-C, IV-G).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.baseline import LONGEST, with_length
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import view_of
from vcl_companion.mapping.joining import Joined, contradiction
from vcl_companion.mapping.known_features import KnownFeatures
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.visibility import visibility_graph
from vcl_companion.vision.essential import RelativePose
from vcl_companion.vision.guided_pairs import match_epipolar
from vcl_companion.vision.resection import NotFound

# How long a baseline may be, of the distance to the scene: least and largest.
_BASELINES = (1e-3, LONGEST)


def join_to_keyframe(
    view: DroneView,
    keyframe: Keyframe,
    shown: KnownFeatures,
    matches: PairMatches,
    known: LandmarkMap,
    options: MapOptions,
    seed: int,
) -> Joined | NotFound:
    """Find a view's pose from what it shares with one keyframe.

    Args:
        view: the view.
        keyframe: where it is, by the map.
        shown: its features.
        matches: features of the keyframe (``a``) and of the view (``b``), wrong ones among them.
        known: the map.
        options: thresholds.
        seed: of the robust search.

    Returns:
        The pose, with the links to landmarks that agree; or why there is none.
    """
    if len(matches.a) < options.min_landmarks:
        return NotFound(f"{len(matches.a)} matches with a keyframe, {options.min_landmarks} needed")
    # The map's axes are the world's: its attitude is known.
    attitude = keyframe.world_from_body.rotation
    other = replace(view_of(keyframe), ned_from_body=attitude, features=shown.features)
    edge = visibility_graph([other, view], options, seed, {(0, 1): matches})[0, 1]
    if not isinstance(edge.chosen, RelativePose):
        return NotFound(edge.chosen.reason)
    b_from_a = edge.chosen.b_from_a
    links = _on_lines(shown, keyframe.camera, view, b_from_a)
    world_from_a = keyframe.world_from_body @ keyframe.body_from_cam
    found = with_length(
        b_from_a,
        world_from_a.inverse().apply(known.points_world[links.a]),
        view.camera.ideal_from_pixels(view.pixels[links.b]),
        view.camera,
        options,
    )
    if isinstance(found, NotFound):
        return found
    b_from_a, agree = found
    world_from_body = world_from_a @ b_from_a.inverse() @ view.body_from_cam.inverse()
    reason = contradiction(view, world_from_body, options)
    if reason:
        return NotFound(reason)
    return Joined(world_from_body, PairMatches(links.a[agree], links.b[agree]))


def _on_lines(shown: KnownFeatures, camera: Camera, view: DroneView, b_from_a: Pose) -> PairMatches:
    """Match the landmarks that a keyframe shows along their epipolar lines in a view.

    Of the whole image's features many resemble a landmark's; of those on its line, few.
    """
    none = np.zeros(0, np.intp)
    landmarks, of_view, start_a, start_b = [none], [none], 0, 0
    for mine, theirs in zip(shown.features, view.features, strict=True):
        landmark = shown.landmark[start_a : start_a + len(mine)]
        ideal_a = camera.ideal_from_pixels(mine.pixels)
        ideal_b = view.camera.ideal_from_pixels(theirs.pixels)
        a = np.flatnonzero((landmark >= 0) & np.isfinite(ideal_a[:, 0]))
        b = np.flatnonzero(np.isfinite(ideal_b[:, 0]))
        i, k, _ = match_epipolar(
            mine.subset(a),
            theirs.subset(b),
            ideal_a[a],
            ideal_b[b],
            b_from_a,
            _BASELINES,
            view.camera.focal_px,
        )
        landmarks.append(landmark[a[i]])
        of_view.append(start_b + b[k])
        start_a += len(mine)
        start_b += len(theirs)
    return PairMatches(np.concatenate(landmarks), np.concatenate(of_view))
