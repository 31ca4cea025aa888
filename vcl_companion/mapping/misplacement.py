"""What a landmark is off where it is found again, beside noise: it looks otherwise from elsewhere.

What stands out from a surface shifts against it, what is slanted shows more of itself or less, a
lens bends where its model does not. Part of that is every landmark's own and grows with how far
aside one is: noise. The other part is the same for all that are alike, and so smooth over an
image; no number of landmarks averages it out, and from one keyframe to the next of a flight it
goes on in the same direction. It is small, and decides how exact a map of many keyframes is.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.compiled import writable
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.vision.bundle import observations_of
from vcl_companion.vision.joint_kernels import seen_aside

# All by poses' NEES in rendered flights and in photographs. Whatever a map says of itself:
LEAST_NOISE_PX = 0.03
ASIDE_NOISE_PX = 0.3
"""Where a line of sight lies ``ASIDE_DEG`` aside of their mean; elsewhere by the power of 1.5."""
ASIDE_DEG = 10.0
SMOOTH_PX = 0.09
"""At the image's border, of one of its parts, after moving as far as a landmark is away."""
N_FIELDS = 6 * 3


def misplacement(landmark_map: LandmarkMap) -> tuple[Array, Array]:
    """Return what observations of a map err by, landmark by landmark, each by rising view.

    In common: an affine field over the image for each direction in which the camera moves, in
    proportion to how far it does, measured by the distance of the landmark.

    Returns:
        (M,) by what each errs independently of all others, px, 1 sigma, and (M, 2, F) in common
        with others, px for each 1 sigma of F causes; in the order of ``observations_of``.
    """
    keyframes, seen = landmark_map.keyframes, landmark_map.seen
    first, view = observations_of(seen)
    centres = np.stack([(k.world_from_body @ k.body_from_cam).translation for k in keyframes])
    angle, moved = seen_aside(writable(landmark_map.points_world), centres, first, view)
    aside_px = ASIDE_NOISE_PX * (np.rad2deg(angle) / ASIDE_DEG) ** 1.5
    noise = np.hypot(np.hypot(landmark_map.pixel_noise_px, LEAST_NOISE_PX), aside_px)

    half = np.array([[k.camera.width_px / 2.0, k.camera.height_px / 2.0] for k in keyframes])[view]
    x, y = ((landmark_map.observed_px[seen] - half) / half[:, :1]).T
    one, none = np.ones(len(view)), np.zeros(len(view))
    # Shifts, scale, turn, and the two kinds of shear.
    across = np.stack([one, none, x, -y, x, y], axis=1)
    down = np.stack([none, one, y, x, -y, x], axis=1)
    field = np.stack([across, down], axis=1)[..., None] * (SMOOTH_PX * moved[:, None, None])
    return noise, field.reshape(len(view), 2, N_FIELDS)
