"""What one drone contributes to a map."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.vision.features import Features

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)


def test_a_view_s_pixels_are_those_of_its_detectors_in_order() -> None:
    akaze = Features(np.array([[1.0, 2.0]]), np.zeros((1, 61), np.uint8))
    sift = Features(np.array([[3.0, 4.0], [5.0, 6.0]]), np.zeros((2, 128), np.float32))
    view = DroneView(1, 0, CAMERA, Pose.identity(), None, b"", (akaze, sift))
    np.testing.assert_array_equal(view.pixels, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
