"""What a landmark is off where it is found again, beside noise: it looks otherwise from elsewhere.

What stands out from a surface shifts against it, what is slanted shows more of itself or less, a
lens bends where its model does not. Part of that is every landmark's own and grows with how far
aside one is: noise. The other part is the same for all that are alike, and so smooth over an
image; no number of landmarks averages it out, and from one keyframe to the next of a flight it
goes on in the same direction. It is small, and decides how exact a map of many keyframes is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap

# All by poses' NEES in rendered flights and in photographs. Whatever a map says of itself:
LEAST_NOISE_PX = 0.03
ASIDE_NOISE_PX = 0.3
"""At ``ASIDE_DEG``; elsewhere by the power of 1.5 of the angle."""
ASIDE_DEG = 10.0
SMOOTH_PX = 0.09
"""At the image's border, of one of its parts, after moving as far as a landmark is away."""
N_FIELDS = 6 * 3


def noise_px(landmark_map: LandmarkMap) -> Array:
    """Return (N, V) what each observation errs by, independently of all others, px, 1 sigma."""
    aside_px = ASIDE_NOISE_PX * (_aside_deg(landmark_map) / ASIDE_DEG) ** 1.5
    return np.asarray(np.hypot(np.hypot(landmark_map.pixel_noise_px, LEAST_NOISE_PX), aside_px))


def smooth_px(landmark_map: LandmarkMap) -> Iterator[Array]:
    """Yield of each view (M, 2, F) by how much it errs in common, px for each 1 sigma of F causes.

    An affine field over the image for each direction in which the camera moves, in proportion to
    how far it does, measured by the distance of the landmark; of the M landmarks that it sees.
    """
    centres, seen = _centres(landmark_map), landmark_map.seen
    n_views = np.maximum(seen.sum(axis=1), 1)[:, None]
    away = np.linalg.norm(landmark_map.points_world[:, None] - centres, axis=2)
    middle = (seen @ centres) / n_views
    distance = np.where(seen, away, 0.0).sum(axis=1)[:, None] / n_views
    for i, keyframe in enumerate(landmark_map.keyframes):
        rows = np.flatnonzero(seen[:, i])
        moved = SMOOTH_PX * (centres[i] - middle[rows]) / distance[rows]
        half = np.array([keyframe.camera.width_px, keyframe.camera.height_px]) / 2.0
        x, y = ((landmark_map.observed_px[rows, i] - half) / half[0]).T
        one, none = np.ones(len(rows)), np.zeros(len(rows))
        # Shifts, scale, turn, and the two kinds of shear.
        across = np.stack([one, none, x, -y, x, y], axis=1)
        down = np.stack([none, one, y, x, -y, x], axis=1)
        field = np.stack([across, down], axis=1)[..., None] * moved[:, None, None]
        yield np.asarray(field.reshape(len(moved), 2, N_FIELDS))


def _centres(landmark_map: LandmarkMap) -> Array:
    """Return (V, 3) where the keyframes' cameras were, world, m."""
    keyframes = landmark_map.keyframes
    return np.stack([(k.world_from_body @ k.body_from_cam).translation for k in keyframes])


def _aside_deg(landmark_map: LandmarkMap) -> Array:
    """Return (N, V) how far each line of sight to a landmark lies aside of their mean, degrees."""
    sight = landmark_map.points_world[:, None] - _centres(landmark_map)
    sight /= np.linalg.norm(sight, axis=2, keepdims=True)
    mean = np.where(landmark_map.seen[..., None], sight, 0.0).sum(axis=1)
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    return np.asarray(np.rad2deg(np.arccos(np.clip(np.einsum("nvi,ni->nv", sight, mean), -1, 1))))
