"""How long the baseline of a relative pose is, from the few landmarks that both views show.

Two views fix all of their relative pose but the length of its translation (IV-B). Where they
share hundreds of features with each other, and hardly any with a third, a handful of
landmarks that are placed already gives that length, where it takes twenty to resect a pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import LOOSE
from vcl_companion.mapping.options import MapOptions
from vcl_companion.vision.information import robust_sigma
from vcl_companion.vision.resection import NotFound

Mask = NDArray[np.bool_]

# A wrong match that lies on its epipolar line agrees with a length once in a hundred: six of
# twenty do by chance once in a million.
_LEAST = 6
# Half of those that show a length must agree on it.
_LEAST_SHARE = 0.5


def with_length(
    b_from_a: Pose,
    points_a: Array,
    ideal_b: Array,
    focal_px: float,
    options: MapOptions,
) -> tuple[Pose, Mask] | NotFound:
    """Give a relative pose its length.

    Args:
        b_from_a: camera a's coordinates to camera b's, the translation of length 1.
        points_a: (M, 3) landmarks, in camera a's coordinates.
        ideal_b: (M, 2) where camera b shows them, ideal image coordinates; wrong ones among them.
        focal_px: of camera b, px per ideal unit.
        options: who agrees misses its landmark by no more than ``LOOSE`` times ``max_error_px``;
            the length may be as vague as depths, by ``max_depth_error``.

    Returns:
        The pose in the landmarks' unit, and (M,) which of them agree; or why there is none.
    """
    limit_px = LOOSE * options.max_error_px
    turned = points_a @ b_from_a.rotation.T
    rays = np.column_stack([ideal_b, np.ones(len(ideal_b))])
    # x (R p + s t) = 0 for the cross product with the ray x: one s of each landmark.
    across_p, across_t = np.cross(rays, turned), np.cross(rays, b_from_a.translation)
    with np.errstate(divide="ignore", invalid="ignore"):
        lengths = -np.einsum("ni,ni->n", across_p, across_t) / np.einsum(
            "ni,ni->n", across_t, across_t
        )
    tried = lengths[np.isfinite(lengths) & (lengths > 0.0)]
    if len(tried) < _LEAST:
        return NotFound(f"{len(tried)} landmarks tell how long the baseline is, {_LEAST} needed")
    agree = np.array([_agree(s, b_from_a, turned, ideal_b, focal_px, limit_px) for s in tried])
    best = agree[np.argmax(agree.sum(axis=1))]
    n = int(best.sum())
    if n < max(_LEAST, _LEAST_SHARE * len(points_a)):
        return NotFound(f"{n} of {len(points_a)} landmarks agree on how long the baseline is")
    length = float(np.median(lengths[best]))
    vague = robust_sigma(lengths[best] - length) / np.sqrt(n) / length
    if vague > options.max_depth_error:
        return NotFound(f"{n} landmarks tell how long the baseline is to {100 * vague:.0f} % only")
    agreeing = _agree(length, b_from_a, turned, ideal_b, focal_px, limit_px)
    return Pose(b_from_a.rotation, length * b_from_a.translation), agreeing


def _agree(
    length: float, b_from_a: Pose, turned: Array, ideal_b: Array, focal_px: float, limit_px: float
) -> Mask:
    points = turned + length * b_from_a.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(points[:, :2] / points[:, 2:] - ideal_b, axis=1) * focal_px
    return np.asarray((points[:, 2] > 0.0) & (error < limit_px))
