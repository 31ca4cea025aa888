"""How long the baseline of a relative pose is, from the few landmarks that both views show.

Two views fix all of their relative pose but the length of its translation (IV-B). Where they
share hundreds of features with each other, and hardly any with a third, a handful of
landmarks that are placed already gives that length, where it takes twenty to resect a pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import LOOSE
from vcl_companion.mapping.options import MapOptions
from vcl_companion.vision.information import robust_sigma
from vcl_companion.vision.resection import NotFound

Mask = NDArray[np.bool_]

# Fewer tell nothing, whatever they agree on.
_LEAST = 6
# So many lengths on which as many agree are expected of wrong matches alone.
_BY_CHANCE = 1e-4


def with_length(
    b_from_a: Pose,
    points_a: Array,
    ideal_b: Array,
    camera_b: Camera,
    options: MapOptions,
) -> tuple[Pose, Mask] | NotFound:
    """Give a relative pose its length.

    Args:
        b_from_a: camera a's coordinates to camera b's, the translation of length 1.
        points_a: (M, 3) landmarks, in camera a's coordinates.
        ideal_b: (M, 2) where camera b shows them, ideal image coordinates; wrong ones among
            them, on their epipolar lines or anywhere.
        camera_b: its intrinsics.
        options: who agrees misses its landmark by no more than ``LOOSE`` times ``max_error_px``;
            the length may be as vague as depths, by ``max_depth_error``.

    Returns:
        The pose in the landmarks' unit, and (M,) which of them agree; or why there is none.
        A length is believed when so many wrong matches, each anywhere on its epipolar line,
        would hardly agree on one.
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
    telling = np.isfinite(lengths) & (lengths > 0.0)
    tried = lengths[telling]
    if len(tried) < _LEAST:
        return NotFound(f"{len(tried)} landmarks tell how long the baseline is, {_LEAST} needed")
    focal_px = camera_b.focal_px
    agree = np.array([_agree(s, b_from_a, turned, ideal_b, focal_px, limit_px) for s in tried])
    best = agree[np.argmax(agree.sum(axis=1))]
    n = int(best.sum())
    windows = _windows(b_from_a, turned[telling], camera_b, limit_px)
    if n < _LEAST or _by_chance(n, windows) > _BY_CHANCE:
        return NotFound(f"{n} of {len(tried)} landmarks agree on how long the baseline is")
    length = float(np.median(lengths[best]))
    vague = robust_sigma(lengths[best] - length) / np.sqrt(n) / length
    if vague > options.max_depth_error:
        return NotFound(f"{n} landmarks tell how long the baseline is to {100 * vague:.0f} % only")
    agreeing = _agree(length, b_from_a, turned, ideal_b, focal_px, limit_px)
    return Pose(b_from_a.rotation, length * b_from_a.translation), agreeing


def _by_chance(n: int, windows: Array) -> float:
    """Return on how many of their lengths so many of M landmarks agree if all are wrong.

    Each agrees with its own probability, one of (M,) windows; as many with the mean of these do so
    no less often (W. Hoeffding, On the distribution of the number of successes in independent
    trials, 1956).
    """
    n_all = len(windows)
    return n_all * float(bdtrc(n - 2, n_all - 1, windows.mean()))


def _windows(b_from_a: Pose, turned: Array, camera_b: Camera, limit_px: float) -> Array:
    """Return (M,) what part of a landmark's epipolar line agrees with any one length.

    The line runs from where the landmark is without a baseline to the epipole, or out of the
    image: half of its diagonal, as a rule.
    """
    out_px = 0.5 * float(np.hypot(camera_b.width_px, camera_b.height_px))
    towards = b_from_a.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = turned[:, :2] / turned[:, 2:] - towards[:2] / towards[2]
        line_px = np.linalg.norm(ends, axis=1) * camera_b.focal_px
    ends_inside = (turned[:, 2] > 0.0) & (towards[2] > 0.0) & (line_px < out_px)
    line_px = np.where(ends_inside, line_px, out_px)
    return np.asarray(np.minimum(1.0, 2.0 * limit_px / np.maximum(line_px, limit_px)))


def _agree(
    length: float, b_from_a: Pose, turned: Array, ideal_b: Array, focal_px: float, limit_px: float
) -> Mask:
    points = turned + length * b_from_a.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.linalg.norm(points[:, :2] / points[:, 2:] - ideal_b, axis=1) * focal_px
    return np.asarray((points[:, 2] > 0.0) & (error < limit_px))
