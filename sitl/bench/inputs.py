"""What the steps are measured on: images of the embedded demo recording, their map, the truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sitl.embedded import DEMO
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import MapOptions, NoMap, reconstruct
from vcl_companion.recording.images import load_image
from vcl_companion.recording.recording import Drone, read_recording
from vcl_companion.vision.features import Detector, FeatureOptions, Features, Image, detect
from vcl_companion.vision.matching import MatchOptions, match_mutual, match_to_entries

FEATURES = FeatureOptions()
MATCHING = MatchOptions()
DETECTORS: tuple[Detector, ...] = ("akaze", "sift", "orb")

# A drone other than the leader, two seconds after the map.
_DRONE, _FRAME = 1, 10


@dataclass(frozen=True, eq=False)
class View:
    """One image, and from where it was taken.

    Attributes:
        image: (H, W) uint8.
        camera: its intrinsics.
        body_from_cam: its mounting.
        world_from_body: the truth, in the map's world.
        features: by detector.
    """

    image: Image
    camera: Camera
    body_from_cam: Pose
    world_from_body: Pose
    features: Mapping[Detector, Features]

    @property
    def cam_from_world(self) -> Pose:
        """The truth, of the camera."""
        return (self.world_from_body @ self.body_from_cam).inverse()


@dataclass(frozen=True, eq=False)
class Inputs:
    """Everything.

    Attributes:
        a, b: the images of two drones in the map.
        frame: the image to localize.
        matches_a, matches_b: (M, 2) ideal coordinates of AKAZE's matches of a and b.
        landmark_map, index: of the first images of all drones.
        seen, landmarks: (K, 2) ideal coordinates in ``frame``, (K, 3) what they were matched to.
    """

    a: View
    b: View
    frame: View
    matches_a: Array
    matches_b: Array
    landmark_map: LandmarkMap
    index: MapIndex
    seen: Array
    landmarks: Array

    @property
    def b_from_a(self) -> Pose:
        """The true relative pose of the two cameras, m."""
        return self.b.cam_from_world @ self.a.cam_from_world.inverse()


def prepare() -> Inputs:
    """Detect, match and map the demo.

    Raises:
        RecordingError: the recording is broken, or cannot be mapped.
    """
    drones = read_recording(DEMO).drones
    origin = _truth(drones[0], 0).translation
    views = [_view(drone, 0, origin) for drone in drones]
    a, b, frame = views[0], views[1], _view(drones[_DRONE], _FRAME, origin)
    i, k = match_mutual(a.features["akaze"], b.features["akaze"], MATCHING)
    offset = a.world_from_body.translation - b.world_from_body.translation
    landmark_map = reconstruct(
        [_drone_view(n + 1, view) for n, view in enumerate(views)],
        1,
        [(1, 2, float(np.linalg.norm(offset)))],
        MapOptions(),
    )
    if isinstance(landmark_map, NoMap):
        raise RecordingError(f"{DEMO}: cannot be mapped: {landmark_map.reason}")
    index = index_map(landmark_map, "akaze", FEATURES)
    found, owner = match_to_entries(frame.features["akaze"], index.entries, index.owner, MATCHING)
    return Inputs(
        a,
        b,
        frame,
        a.camera.ideal_from_pixels(a.features["akaze"].pixels[i]),
        b.camera.ideal_from_pixels(b.features["akaze"].pixels[k]),
        landmark_map,
        index,
        frame.camera.ideal_from_pixels(frame.features["akaze"].pixels[found]),
        landmark_map.points_world[owner],
    )


def _truth(drone: Drone, number: int) -> Pose:
    found = None if drone.truth is None else drone.truth.pose_at(drone.frames[number].at_ns)
    if found is None:
        raise RecordingError(f"{DEMO}: {drone.name} has no truth for its frame {number}")
    return found


def _view(drone: Drone, number: int, origin: Array) -> View:
    camera = drone.sensor.camera
    image = load_image(drone.frames[number].path, camera)
    truth = _truth(drone, number)
    features = {name: detect(image, name, FEATURES) for name in DETECTORS}
    world_from_body = Pose(truth.rotation, truth.translation - origin)
    return View(image, camera, drone.sensor.body_from_cam, world_from_body, features)


def _drone_view(drone_id: int, view: View) -> DroneView:
    sent = encode_image(view.image, MapOptions().keyframe_quality)
    image = decode_image(sent, view.camera)
    return DroneView(
        drone_id,
        0,
        view.camera,
        view.body_from_cam,
        view.world_from_body.rotation,
        sent,
        tuple(detect(image, name, FEATURES) for name in MapOptions().detectors),
    )
