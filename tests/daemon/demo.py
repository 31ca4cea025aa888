"""Small pictures of the committed demo, the map of its first ones, and where they were taken."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_building import Distances, build_map, update_map
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import MapOptions
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.recording import Recording, read_recording
from vcl_companion.recording.images import load_image
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.group import SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.vision.features import FeatureOptions, Features
from vcl_companion.vision.hamming import hamming_index
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

DEMO = Path(__file__).parents[2] / "sitl" / "recordings" / "demo"
# One detector: the map is good enough, and made in half a second.
MAP_OPTIONS = MapOptions(detectors=("akaze",), member_wait_s=60.0)
FEATURES = FeatureOptions()
LEADER = 1


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture, at half the size, and where it was taken (north-east-down)."""

    image: NDArray[np.uint8]
    at_ns: int
    ned_from_body: Pose


@functools.cache
def recording() -> Recording:
    return read_recording(DEMO)


@functools.cache
def sensor(system_id: int) -> Sensor:
    full = recording().drones[system_id - 1].sensor
    c = full.camera
    centre = ((c.cx_px + 0.5) / 2 - 0.5, (c.cy_px + 0.5) / 2 - 0.5)
    half = Camera(c.width_px // 2, c.height_px // 2, c.fx_px / 2, c.fy_px / 2, *centre)
    return replace(full, camera=half)


@functools.cache
def shot(system_id: int, k: int = 0) -> Shot:
    drone = recording().drones[system_id - 1]
    file = drone.frames[k]
    image = cv2.resize(
        load_image(file.path, drone.sensor.camera), None, fx=0.5, fy=0.5,
        interpolation=cv2.INTER_AREA,
    )  # fmt: skip
    assert drone.truth is not None
    pose = drone.truth.pose_at(file.at_ns)
    assert pose is not None
    return Shot(np.asarray(image, dtype=np.uint8), file.at_ns, pose)


def frame(system_id: int, k: int = 0, image: NDArray[np.uint8] | None = None) -> Frame:
    """The frame of a drone; another image may stand in for what it saw."""
    taken = shot(system_id, k)
    return Frame(taken.image if image is None else image, taken.at_ns, k, 0)


def blank(system_id: int) -> NDArray[np.uint8]:
    """A picture in which nothing can be found."""
    return np.full_like(shot(system_id).image, 90)


def png(image: NDArray[np.uint8]) -> bytes:
    ok, encoded = cv2.imencode(".png", image)
    assert ok
    return bytes(encoded)


def known_distances(*system_ids: int) -> Distances:
    """The distance of the first two of some drones, when the recording begins."""
    a, b = (shot(system_id).ned_from_body.translation for system_id in system_ids[:2])
    return ((system_ids[0], system_ids[1], float(np.linalg.norm(a - b))),)


def workshop(
    swarm: SwarmOptions,
    sensor: Sensor,
    inter: InterMavOptions,
    localization: LocalizationOptions | None = None,
) -> Workshop:
    """What makes maps for one drone, and searches them."""
    localization = localization or LocalizationOptions()
    pipeline = PipelineOptions(FEATURES, localization, TrackingOptions())
    options = WorkOptions(
        swarm.known_distances, MAP_OPTIONS, pipeline, ("akaze",), inter, tracked=False
    )
    return Workshop(sensor, options)


def answer(system_id: int, k: int = 0, request_id: int = 1) -> FrameAnswer:
    """The answer that a drone gives of a frame."""
    taken, own = shot(system_id, k), sensor(system_id)
    image_bytes = encode_image(taken.image, MAP_OPTIONS.keyframe_quality)
    return FrameAnswer(
        system_id, request_id, taken.at_ns, 0.0, taken.ned_from_body.quaternion(),
        own.body_from_cam, own.camera, image_bytes,
    )  # fmt: skip


@functools.cache
def encoded_map(*system_ids: int) -> bytes:
    """The map of the first frames of some drones."""
    built = build_map(
        [answer(system_id) for system_id in system_ids], LEADER, known_distances(*system_ids),
        MAP_OPTIONS, FeatureMemory(FEATURES),
    )  # fmt: skip
    assert isinstance(built, LandmarkMap)
    return encode_map(built)


@functools.cache
def encoded_update() -> bytes:
    """The next revision of the map of 1 and 2, with a later frame of all three."""
    stored = StoredMap(revision_of(encoded_map(1, 2)), encoded_map(1, 2), map_index(1, 2))
    frames = [answer(system_id, 12) for system_id in (1, 2, 3)]
    made = update_map(stored, frames, MAP_OPTIONS, FeatureMemory(FEATURES), at_once=False)
    assert isinstance(made, LandmarkMap)
    return encode_map(made)


@functools.cache
def update_index() -> MapIndex:
    return index_map(decode_map(encoded_update()), "akaze", FEATURES)


@functools.cache
def map_index(*system_ids: int) -> MapIndex:
    return index_map(decode_map(encoded_map(*system_ids)), "akaze", FEATURES)


def unrecognisable(index: MapIndex) -> MapIndex:
    """The same map by a detector that sees nothing special in any of it."""
    blank = np.zeros_like(index.entries.descriptors, dtype=np.uint8)
    entries = Features(index.entries.pixels, blank)
    return replace(index, entries=entries, search=hamming_index(blank, index.owner))


@functools.cache
def templates(*system_ids: int) -> Templates:
    index = map_index(*system_ids)
    return prepare_templates(index.landmark_map, index.uncertainty)


def world_from_body(system_id: int, k: int) -> Pose:
    """Where a frame was taken, in the world of a first map: the leader's first place is zero."""
    pose = shot(system_id, k).ned_from_body
    return Pose(pose.rotation, pose.translation - shot(LEADER).ned_from_body.translation)
