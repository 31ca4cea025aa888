"""First maps of photographs of a court with rows of like windows, against where they were taken."""

from pathlib import Path

import numpy as np
import pytest

from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.recording.images import load_image
from vcl_companion.recording.recording import read_recording
from vcl_companion.vision.features import FeatureOptions, detect

CASTLE = Path(__file__).parents[3] / "shared" / "data" / "castle-P19"
OPTIONS = MapOptions()


# Windows taken for the next ones bent these by 10, 40 and 40 cm.
@pytest.mark.parametrize("k", [2, 6, 7])
def test_windows_taken_for_the_next_ones_bend_no_map(k: int) -> None:
    if not CASTLE.is_dir():
        pytest.skip("../shared/data is not here")
    views, truths = [], []
    for number, drone in enumerate(read_recording(CASTLE).drones):
        frame, camera = drone.frames[k], drone.sensor.camera
        truth = drone.truth.pose_at(frame.at_ns) if drone.truth else None
        assert truth is not None
        data = encode_image(load_image(frame.path, camera), OPTIONS.keyframe_quality)
        image = decode_image(data, camera)
        features = tuple(detect(image, d, FeatureOptions()) for d in OPTIONS.detectors)
        mounting = drone.sensor.body_from_cam
        views.append(
            DroneView(number + 1, frame.at_ns, camera, mounting, truth.rotation, data, features)
        )
        truths.append(truth)
    apart_m = float(np.linalg.norm(truths[1].translation - truths[0].translation))

    made = reconstruct(views, 1, [(1, 2, apart_m)], OPTIONS)

    assert isinstance(made, LandmarkMap), made
    first, second = (keyframe.world_from_body for keyframe in made.keyframes)
    off = (first.inverse() @ second).inverse() @ (truths[0].inverse() @ truths[1])
    assert np.linalg.norm(off.translation) < 0.06
