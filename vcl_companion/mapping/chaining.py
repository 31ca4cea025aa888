"""A view joined to a map by its relative pose with one keyframe, where few landmarks tell the rest.

Who looks from far aside shares features with the nearest keyframe, of which hardly any is a
landmark yet: what is mapped is what the drones before saw together (IV-C, IV-G).
"""

from __future__ import annotations

from dataclasses import replace

from vcl_companion.mapping.baseline import with_length
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import view_of
from vcl_companion.mapping.joining import Joined, contradiction
from vcl_companion.mapping.known_features import KnownFeatures
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.visibility import visibility_graph
from vcl_companion.vision.essential import RelativePose
from vcl_companion.vision.resection import NotFound


def join_to_keyframe(
    view: DroneView,
    k: int,
    shown: KnownFeatures,
    matches: PairMatches,
    known: LandmarkMap,
    options: MapOptions,
    seed: int,
) -> Joined | NotFound:
    """Find a view's pose from what it shares with one keyframe.

    Args:
        view: the view.
        k: the keyframe, of the map.
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
    keyframe = known.keyframes[k]
    # The map's axes are the world's: its attitude is known.
    attitude = keyframe.world_from_body.rotation
    other = replace(view_of(keyframe), ned_from_body=attitude, features=shown.features)
    edge = visibility_graph([other, view], options, seed, {(0, 1): matches})[0, 1]
    if not isinstance(edge.chosen, RelativePose):
        return NotFound(edge.chosen.reason)
    landmark = shown.landmark[edge.matches.a]
    links = PairMatches(landmark[landmark >= 0], edge.matches.b[landmark >= 0])
    world_from_a = keyframe.world_from_body @ keyframe.body_from_cam
    found = with_length(
        edge.chosen.b_from_a,
        world_from_a.inverse().apply(known.points_world[links.a]),
        view.camera.ideal_from_pixels(view.pixels[links.b]),
        view.camera.focal_px,
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
