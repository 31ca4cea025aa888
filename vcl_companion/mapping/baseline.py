"""How long the baseline of a relative pose is, from the few landmarks that both views show.

Two views fix all of their relative pose but the length of its translation (IV-B). Where they
share hundreds of features with each other, and hardly any with a third, a handful of
landmarks that are placed already gives that length, where it takes twenty to resect a pose.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import rel_entr

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
# How long a baseline may be, of the distance to the scene; epipolar lines are followed in steps.
LONGEST = 3.0
_STEPS = 100


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
    looks = [_at_length(s, b_from_a, turned, ideal_b, camera_b, limit_px) for s in tried]
    agree, visible = np.array(looks).swapaxes(0, 1)
    windows = _windows(b_from_a, turned, camera_b, limit_px)
    by_chance = _by_chance(agree, visible, windows)
    chosen = int(np.argmin(by_chance))
    best = agree[chosen][telling]
    n = int(best.sum())
    if n < _LEAST or by_chance[chosen] > np.log(_BY_CHANCE):
        return NotFound(f"{n} of {len(tried)} landmarks agree on how long the baseline is")
    length = float(np.median(tried[best]))
    vague = robust_sigma(tried[best] - length) / np.sqrt(n) / length
    if vague > options.max_depth_error:
        return NotFound(f"{n} landmarks tell how long the baseline is to {100 * vague:.0f} % only")
    agreeing, _ = _at_length(length, b_from_a, turned, ideal_b, camera_b, limit_px)
    return Pose(b_from_a.rotation, length * b_from_a.translation), agreeing


def _by_chance(agree: Mask, visible: Mask, windows: Array) -> Array:
    """Return on how many lengths so many landmarks agree if all are wrong, as (L,) logarithms.

    Whom a length puts outside the image cannot agree on it. Of the others each agrees with its
    own probability, one of (M,) windows; as many with the mean of these do so no less often,
    and no more often than the bound says (W. Hoeffding, On the distribution of the number of
    successes in independent trials, 1956; Probability inequalities for sums of bounded random
    variables, 1963, eq. 2.1). Who tells a length agrees on it in any case.
    """
    may = agree | visible
    n_may = np.maximum(may.sum(axis=1), 1)
    expected = may @ windows / n_may
    share = np.maximum((agree.sum(axis=1) - 1) / np.maximum(n_may - 1, 1), expected)
    apart = rel_entr(share, expected) + rel_entr(1.0 - share, 1.0 - expected)
    return np.asarray(np.log(len(windows)) - (n_may - 1) * apart)


def _windows(b_from_a: Pose, turned: Array, camera_b: Camera, limit_px: float) -> Array:
    """Return (M,) what part of a landmark's epipolar line agrees with any one length.

    Only the part of the line that the image shows holds matches, wrong ones too: of what a
    camera leaves behind most is short, and wrong matches there agree on a short baseline.
    """
    distance = np.linalg.norm(turned, axis=1)
    line_px, before = np.zeros(len(turned)), np.full((len(turned), 2), np.nan)
    for share in np.linspace(0.0, LONGEST, _STEPS):
        pixels = camera_b.project(turned + (share * distance)[:, None] * b_from_a.translation)
        pixels[~camera_b.shows(pixels, 0.0)] = np.nan
        step_px = np.linalg.norm(pixels - before, axis=1)
        line_px += np.where(np.isfinite(step_px), step_px, 0.0)
        before = pixels
    return np.asarray(np.minimum(1.0, 2.0 * limit_px / np.maximum(line_px, limit_px)))


def _at_length(
    length: float, b_from_a: Pose, turned: Array, ideal_b: Array, camera_b: Camera, limit_px: float
) -> tuple[Mask, Mask]:
    """Return (M,) who agrees on a length, and whom it puts inside the image."""
    points = turned + length * b_from_a.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        off = points[:, :2] / points[:, 2:] - ideal_b
    error_px = np.linalg.norm(off, axis=1) * camera_b.focal_px
    agree = np.asarray((points[:, 2] > 0.0) & (error_px < limit_px))
    return agree, camera_b.shows(camera_b.project(points), 0.0)
