"""What a lens is off its calibration: the same in all images of a camera, smooth over each.

No number of landmarks or frames averages it out, and residuals hardly show it: what a focal length
is off goes into distances, a principal point into rotations. So it is told, not found.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.vision.bundle import observations_of

# Two focal lengths, the principal point, a radial and two decentring coefficients (Brown 1966).
N_LENS = 7
# Four of these act along a direction at the border, alike: together they make what is told.
_EACH = 0.5


def lens_px(camera: Camera, pixels: Array, calibration_px: float) -> Array:
    """Return (M, 2, 7) what pixels are off by each of a lens's 1-sigma errors, px.

    Args:
        camera: the lens, as it is calibrated.
        pixels: (M, 2).
        calibration_px: what it is off in all at the left and right border, in each direction
            about so much, 1 sigma.
    """
    half = camera.width_px / 2.0
    x, y = ((pixels - (camera.cx_px, camera.cy_px)) / half).T
    one, none, square = np.ones(len(pixels)), np.zeros(len(pixels)), x * x + y * y
    across = [x, none, one, none, x * square, (square + 2.0 * x * x) / 3.0, 2.0 * x * y / 3.0]
    down = [none, y, none, one, y * square, 2.0 * x * y / 3.0, (square + 2.0 * y * y) / 3.0]
    field = np.stack([np.stack(across, axis=1), np.stack(down, axis=1)], axis=1)
    return np.asarray(_EACH * calibration_px * field)


def n_lens_causes(landmark_map: LandmarkMap) -> int:
    """Return how many errors the lenses of all drones of a map have: each drone's is its own."""
    return N_LENS * len(_drones(landmark_map))


def lenses_px(landmark_map: LandmarkMap, calibration_px: float) -> Array:
    """Return (M, 2, F) what all lenses' errors do to what is seen; see ``lens_px``.

    In the order of ``misplacement``.
    """
    drones, seen = _drones(landmark_map), landmark_map.seen
    _, view = observations_of(seen)
    pixels = landmark_map.observed_px[seen]
    out = np.zeros((len(view), 2, N_LENS * len(drones)))
    for i, keyframe in enumerate(landmark_map.keyframes):
        rows = view == i
        first = N_LENS * drones.index(keyframe.drone_id)
        of_view = lens_px(keyframe.camera, pixels[rows], calibration_px)
        out[rows, :, first : first + N_LENS] = of_view
    return out


def _drones(landmark_map: LandmarkMap) -> Sequence[int]:
    return sorted({keyframe.drone_id for keyframe in landmark_map.keyframes})
