"""How likely a relative pose makes all matches, those on a plane counted as such (IV-B), compiled.

A match on a known plane says two numbers of the poses that can have made it, any
other match one: how far it is from its epipolar line. Poses of a scene that is
mostly plane are therefore not to be told apart by epipolar distances alone: a
wrong pose that has left the plane comes near to a few wrong matches more.
Matches are a mixture of three kinds here: near the plane (across the epipolar
line by the pixels' noise, along it by relief as well), anywhere on their line, and
wrong. Shares, noise and relief are estimated along (expectation maximisation).
The planar twins differ by what is not on the plane, and by what is in front of
the cameras.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, skew
from vcl_companion.vision.acransac import Mask
from vcl_companion.vision.epipolar import squared_sampson

_ROUNDS = 24
# The plane is fitted anew every so many rounds.
_ROUNDS_PER_PLANE = 3
_SETTLED = 0.02
_FINEST_PX = 0.01
_LARGEST = 1e12
_NEVER = -50.0


def plausibility(
    pose: Pose,
    ideal_a: Array,
    ideal_b: Array,
    focal_px: float,
    possible: Mask,
    near_plane: tuple[Mask, float] | None,
    sigma_px: float,
    diagonal_px: float,
    area_px2: float,
) -> float:
    """Return how much likelier matches are under a pose than if all were wrong, as a logarithm.

    Args:
        pose: b_from_a, the translation of length 1.
        ideal_a: (N, 2) ideal image coordinates in camera a.
        ideal_b: (N, 2) the same places in camera b.
        focal_px: px per ideal unit.
        possible: (N,) bool, matches that may be right: in front of both cameras.
        near_plane: (N,) bool, matches that a plane explains, and how far they are from
            where it puts them, px, 1 sigma, about; None without a plane.
        sigma_px: first guess of the noise of one pixel coordinate.
        diagonal_px: of the part of the images in which wrong matches lie.
        area_px2: of the same.
    """
    a, b = np.ascontiguousarray(ideal_a), np.ascontiguousarray(ideal_b)
    essential = skew(pose.translation) @ pose.rotation
    weight, spread_px = np.zeros(len(a)), 0.0
    if near_plane is not None:
        weight, spread_px = near_plane[0].astype(np.float64), near_plane[1]
    gain = _plausibility(
        np.array(pose.rotation, order="C"), pose.translation.copy(), a, b, focal_px,
        squared_sampson(essential[None], a, b, focal_px)[0], possible.copy(), weight,
        sigma_px, spread_px, np.sqrt(2.0) * diagonal_px / area_px2, 1.0 / area_px2, _ROUNDS,
    )  # fmt: skip
    return float(gain)


@compiled
def _plausibility(
    rotation: Array, direction: Array, a: Array, b: Array, focal_px: float,
    squared_line: Array, possible: Mask, weight: Array,
    sigma_px: float, spread_px: float, line_density: float, point_density: float, rounds: int,
) -> float:  # fmt: skip
    """Return the log likelihood ratio; ``weight`` is that of each match near the plane, at first.

    Densities of wrong matches: per px of distance from a line, per px^2.
    """
    n = len(a)
    ceiling = 3.0 * sigma_px
    across, along = np.full(n, _LARGEST), np.full(n, _LARGEST)
    depth = np.ones(n)
    with_plane = weight.sum() > 0.0
    plane_share, line_share = (0.3, 0.1) if with_plane else (0.0, 0.4)
    gain, gain_before = 0.0, -np.inf
    for r in range(rounds):
        if with_plane and r % _ROUNDS_PER_PLANE == 0:
            for _ in range(3 if r == 0 else 1):
                _fit_plane(rotation, direction, a, b, focal_px, weight, depth, across, along)
        wrong_share = max(1.0 - plane_share - line_share, 1e-3)
        # Across the line there is the noise of both images, along it depth off the plane as well.
        narrow = 2.0 * sigma_px**2
        wide = max(spread_px**2, narrow)
        plane_peak = plane_share / (2.0 * np.pi * np.sqrt(narrow * wide) * point_density)
        line_peak = line_share / (np.sqrt(2.0 * np.pi) * sigma_px * line_density)
        plane_sum, line_sum, narrow_sum, wide_sum, gain = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            near_plane, on_line = 0.0, 0.0
            if possible[i]:
                exponent = -0.5 * (across[i] / narrow + along[i] / wide)
                if exponent > _NEVER:
                    near_plane = plane_peak * np.exp(exponent)
                exponent = -0.5 * squared_line[i] / sigma_px**2
                if exponent > _NEVER:
                    on_line = line_peak * np.exp(exponent)
            total = near_plane + on_line + wrong_share
            gain += np.log(total)
            weight[i] = near_plane / total
            plane_sum += weight[i]
            line_sum += on_line / total
            narrow_sum += 0.5 * weight[i] * across[i] + on_line / total * squared_line[i]
            wide_sum += weight[i] * along[i]
        # The pose takes five degrees of freedom out of the distances across, the plane three.
        sigma_px = np.sqrt(narrow_sum / max(plane_sum + line_sum - 5.0, 1.0))
        sigma_px = min(max(sigma_px, _FINEST_PX), ceiling)
        spread_px = np.sqrt(wide_sum / max(plane_sum - 3.0, 1.0))
        plane_share = max(plane_sum / n, 1e-3) if with_plane else 0.0
        line_share = max(line_sum / n, 1e-3)
        if (r + 1) % _ROUNDS_PER_PLANE == 0:
            if abs(gain - gain_before) < _SETTLED:
                break
            gain_before = gain
    return gain


@compiled
def _fit_plane(
    rotation: Array, direction: Array, a: Array, b: Array, focal_px: float,
    weight: Array, depth: Array, across: Array, along: Array,
) -> None:  # fmt: skip
    """Fit n in H = R + t n^T to weighted matches; fill how far b is from H a, squared, px^2.

    H a lies on the epipolar line whatever n is: ``across`` and ``along`` are the
    two parts of the distance. ``depth`` is that of each match by the plane before:
    it makes the equations' errors those of the image.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    turned, ray = np.empty(3), np.ones(3)
    for i in range(len(a)):
        if weight[i] < 1e-6:
            continue
        ray[0], ray[1] = a[i, 0], a[i, 1]
        for j in range(3):
            turned[j] = rotation[j, 0] * ray[0] + rotation[j, 1] * ray[1] + rotation[j, 2] * ray[2]
        each = weight[i] / max(depth[i] * depth[i], 1e-4)
        for k in range(2):
            slope = direction[k] - b[i, k] * direction[2]
            wanted = b[i, k] * turned[2] - turned[k]
            for p in range(3):
                right[p] += each * slope * ray[p] * wanted
                for q in range(3):
                    normal[p, q] += each * slope * slope * ray[p] * ray[q]
    for p in range(3):
        normal[p, p] += 1e-9 * normal[p, p] + 1e-12
    plane = np.linalg.solve(normal, right)
    scale = focal_px * focal_px
    for i in range(len(a)):
        x, y = a[i, 0], a[i, 1]
        share = plane[0] * x + plane[1] * y + plane[2]
        for j in range(3):
            turned[j] = rotation[j, 0] * x + rotation[j, 1] * y + rotation[j, 2]
            turned[j] += share * direction[j]
        depth[i] = turned[2]
        across[i] = along[i] = _LARGEST
        if turned[2] > 1e-6:
            u, v = turned[0] / turned[2], turned[1] / turned[2]
            line_x, line_y = direction[0] - u * direction[2], direction[1] - v * direction[2]
            length = line_x * line_x + line_y * line_y
            off_x, off_y = b[i, 0] - u, b[i, 1] - v
            product = off_x * line_y - off_y * line_x
            across[i] = scale * product * product / max(length, 1e-18)
            along[i] = max(scale * (off_x * off_x + off_y * off_y) - across[i], 0.0)
