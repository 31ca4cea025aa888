"""Matches of real photographs, where the checkout has them beside it."""

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

_DATA = Path(__file__).parents[3] / "shared" / "data"


def photographed(name: str, n_views: int) -> tuple[Camera, list[Pose], Array]:
    """Return camera, true worlds_from_cams and (N, V, 2) ideal coordinates, NaN where unmatched.

    The views are one drone's first frames, all matched against the first by SIFT.
    """
    if not (_DATA / name).is_dir():
        pytest.skip(f"no photographs at {_DATA / name}")
    drone = read_recording(_DATA / name).drones[0]
    camera, truth = drone.sensor.camera, drone.truth
    assert truth is not None
    frames = drone.frames[:n_views]
    poses = []
    for frame in frames:
        world_from_body = truth.pose_at(frame.at_ns)
        assert world_from_body is not None
        poses.append(world_from_body @ drone.sensor.body_from_cam)
    found = [detect(load_image(f.path, camera), "sift", FeatureOptions()) for f in frames]
    ideal = np.full((len(found[0]), n_views, 2), np.nan)
    ideal[:, 0] = camera.ideal_from_pixels(found[0].pixels)
    for view in range(1, n_views):
        i, k = match_mutual(found[0], found[view], MatchOptions())
        ideal[i, view] = camera.ideal_from_pixels(found[view].pixels[k])
    return camera, poses, ideal
