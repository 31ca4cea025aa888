"""What a round builds of its frames: a first map, or the next revision; runs beside the loop.

The next revision may also come of another map, of drones that were on their own for a while.
"""

from __future__ import annotations

from dataclasses import replace

from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.rotation import matrix_from_quaternion
from vcl_companion.mapping.agreement import contradiction
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.merging import merged
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.seen_landmarks import told_pixels
from vcl_companion.mapping.update import extended
from vcl_companion.vision.features import Features
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.map_codec import decode_map, revision_of

Distances = tuple[tuple[int, int, float], ...]


def build_map(
    frames: list[FrameAnswer],
    leader: int,
    known_distances: Distances,
    map_options: MapOptions,
    memory: FeatureMemory,
) -> LandmarkMap | NoMap:
    """Build the first map of a round's frames; takes a second or two.

    Args:
        frames: one of each drone that answered.
        leader: system id of the drone whose body is the world's origin.
        known_distances: (drone, drone, metres).
        map_options: thresholds.
        memory: finds features.

    Returns:
        A map, or why there is none. A frame whose image cannot be used is left
        out, unless it is the leader's.
    """
    views: list[DroneView] = []
    for frame in sorted(frames, key=lambda f: f.drone_id):
        view = _view(frame, map_options, memory)
        if isinstance(view, DroneView):
            views.append(view)
        elif frame.drone_id == leader:
            return NoMap(f"the leader's frame: {view.reason}")
    return reconstruct(views, leader, list(known_distances), map_options)


def update_map(
    stored: StoredMap,
    frames: list[FrameAnswer],
    map_options: MapOptions,
    memory: FeatureMemory,
    *,
    at_once: bool,
) -> LandmarkMap | NoMap:
    """Build the next revision of a map of a round's frames (IV-G).

    Args:
        stored: the map in use.
        frames: of each drone that answered, several of some.
        map_options: thresholds.
        memory: finds features.
        at_once: of the frames only that show the map where their drones say; takes a
            second, the others many.

    Returns:
        A map whose parent is ``stored``, or why there is none. A frame whose
        image cannot be used, or that came twice, is left out.
    """
    shown = {(f.drone_id, f.captured_at_ns): f for f in frames}
    views = [_told(shown[key], stored) for key in sorted(shown)]
    made = extended(
        stored.index.landmark_map,
        stored.revision,
        views,
        memory.features,
        map_options,
        pyramid_of=memory.pyramid,
        sure=stored.index.uncertainty,
        at_once=at_once,
    )
    if isinstance(made, NoMap):
        return made
    # Every member would refuse it.
    why = contradiction(stored.index.landmark_map, stored.index.uncertainty, made)
    return NoMap(f"it contradicts the map in use: {why}") if why else made


def merge_maps(
    stored: StoredMap, data: bytes, map_options: MapOptions, memory: FeatureMemory
) -> LandmarkMap | NoMap:
    """Build the next revision of a map of it and another one; takes some seconds.

    Args:
        stored: the map in use, whose world is kept.
        data: the other one, encoded, the whole of it.
        map_options: thresholds.
        memory: finds features.

    Returns:
        A map whose parent is ``stored`` and which names the other one as joined, or
        why there is none.

    Raises:
        WireError: the bytes are no map.
    """
    return merged(
        stored.index.landmark_map,
        stored.revision,
        decode_map(data),
        revision_of(data),
        memory.features,
        map_options,
        pyramid_of=memory.pyramid,
        sure=stored.index.uncertainty,
    )


def _view(frame: FrameAnswer, map_options: MapOptions, memory: FeatureMemory) -> DroneView | NoMap:
    """Make of a frame what the map builder needs, or say why it cannot be used."""
    try:
        features = tuple(
            memory.features(frame.image_bytes, frame.camera, detector)
            for detector in map_options.detectors
        )
    except ValueError as error:
        return NoMap(str(error))
    return _seen(frame, features)


def _told(frame: FrameAnswer, stored: StoredMap) -> DroneView:
    """Make of a frame what a map is extended by: with what its drone tells that it shows of it."""
    view = _seen(frame, ())
    if frame.world_from_body is None:
        return view
    world_from_cam = frame.world_from_body @ frame.body_from_cam
    landmark_map = stored.index.landmark_map
    told = told_pixels(frame.seen, stored.revision, landmark_map, frame.camera, world_from_cam)
    return replace(view, told_px=told)


def _seen(frame: FrameAnswer, features: tuple[Features, ...]) -> DroneView:
    attitude = frame.ned_from_body
    return DroneView(
        frame.drone_id,
        frame.captured_at_ns,
        frame.camera,
        frame.body_from_cam,
        None if attitude is None else matrix_from_quaternion(attitude),
        frame.image_bytes,
        features,
        frame.world_from_body,
        frame.has_heading,
    )
