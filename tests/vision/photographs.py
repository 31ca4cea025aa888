"""Matches of images: of the embedded demo, and of photographs where they lie beside us."""

from pathlib import Path

import numpy as np
import pytest

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording.images import load_image
from vcl_companion.recording.recording import read_recording
from vcl_companion.vision.features import FeatureOptions, detect
from vcl_companion.vision.matching import MatchOptions, match_mutual

_DEMO = Path(__file__).parents[2] / "sitl" / "recordings" / "demo"
_DATA = Path(__file__).parents[3] / "shared" / "data"


def folder_of(name: str) -> Path:
    """Return where the photographs of a name are; skip the test where they are not."""
    folder = _DEMO if name == "demo" else _DATA / name
    if not folder.is_dir():
        pytest.skip(f"no photographs at {folder}")
    return folder


def photographed(name: str, n_views: int) -> tuple[Camera, list[Pose], Array]:
    """Return camera, true worlds_from_cams and (N, V, 2) ideal coordinates, NaN where unmatched.

    The views are one drone's first frames, of ``demo`` the first frames of its drones,
    all matched against the first by SIFT.
    """
    drones = read_recording(folder_of(name)).drones
    if name == "demo":
        views = [(drone, drone.frames[0]) for drone in drones[:n_views]]
    else:
        views = [(drones[0], frame) for frame in drones[0].frames[:n_views]]
    camera = drones[0].sensor.camera
    poses, found = [], []
    for drone, frame in views:
        world_from_body = None if drone.truth is None else drone.truth.pose_at(frame.at_ns)
        assert world_from_body is not None
        assert drone.sensor.camera == camera
        poses.append(world_from_body @ drone.sensor.body_from_cam)
        found.append(detect(load_image(frame.path, camera), "sift", FeatureOptions()))
    ideal = np.full((len(found[0]), n_views, 2), np.nan)
    ideal[:, 0] = camera.ideal_from_pixels(found[0].pixels)
    for view in range(1, n_views):
        i, k = match_mutual(found[0], found[view], MatchOptions())
        ideal[i, view] = camera.ideal_from_pixels(found[view].pixels[k])
    return camera, poses, ideal
