"""Features of two views of known pose that may be one point: those near its epipolar line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Features

Index = NDArray[np.intp]

_BAND_PX = 3.0
_RATIO = 0.9
# Two features so close together are the same corner: neither makes the other ambiguous.
_SAME_PX = 5.0
_MIN_DEPTH = 0.02
# Unrelated descriptors differ in half of their bits, or by a squared distance of one.
_MAX_BITS_DIFFERENT, _MAX_SQUARED = 0.28, 0.6


def match_epipolar(
    a: Features,
    b: Features,
    ideal_a: Array,
    ideal_b: Array,
    b_from_a: Pose,
    inverse_depths: tuple[float, float],
    focal_px: float,
) -> tuple[Index, Index, Array]:
    """Match features along epipolar lines: each other's best, clearly better than the next.

    Args:
        a: features of one image.
        b: of another.
        ideal_a: (N, 2) where they are, x/z, y/z.
        ideal_b: (K, 2) likewise.
        b_from_a: relative pose of the cameras, metric.
        inverse_depths: least and largest that points have in camera a, 1/m.
        focal_px: of camera b.

    Returns:
        (M,) indices into ``a``, (M,) into ``b``, (M,) inverse depths in camera a, 1/m.
    """
    none = np.zeros(0, np.intp)
    if len(a) == 0 or len(b) == 0:
        return none, none, np.zeros(0)
    first, other, depth = _near_lines(
        np.ascontiguousarray(ideal_a),
        np.ascontiguousarray(ideal_b),
        np.ascontiguousarray(b_from_a.matrix()[:3]),
        inverse_depths[0],
        inverse_depths[1],
        _BAND_PX / focal_px,
    )
    if len(other) == 0:
        return none, none, np.zeros(0)
    owner = np.repeat(np.arange(len(a)), np.diff(first))
    distance = _distances(a, b, owner, other)
    chosen = _clear(first, other, distance, b.pixels, _RATIO, _SAME_PX)
    chosen = chosen[chosen >= 0]
    chosen = chosen[distance[chosen] < _unrelated(a)]
    # Of several that chose the same one the closest stays.
    order = chosen[np.argsort(distance[chosen], kind="stable")]
    _, where = np.unique(other[order], return_index=True)
    kept = np.sort(order[where])
    return owner[kept], other[kept].astype(np.intp), depth[kept]


def _distances(a: Features, b: Features, i: Index, k: NDArray[np.int64]) -> Array:
    """Return (P,) descriptor distances of pairs: Hamming, or squared Euclidean."""
    if a.descriptors.dtype == np.uint8:
        different = np.bitwise_xor(a.descriptors[i], b.descriptors[k])
        return np.asarray(np.bitwise_count(different).sum(axis=1, dtype=np.int64), dtype=np.float64)
    products = np.einsum("pd,pd->p", a.descriptors[i], b.descriptors[k])
    return np.asarray(2.0 - 2.0 * products, dtype=np.float64)


def _unrelated(features: Features) -> float:
    """Return the distance from which on two descriptors have nothing to do with each other."""
    if features.descriptors.dtype == np.uint8:
        return float(_MAX_BITS_DIFFERENT * 8 * features.descriptors.shape[1])
    return _MAX_SQUARED


@compiled
def _near_lines(
    ideal_a: Array, ideal_b: Array, b_from_a: Array, least: float, largest: float, band: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return for each feature of a, as ranges of one list, those of b near its segment."""
    n, k = len(ideal_a), len(ideal_b)
    first = np.zeros(n + 1, dtype=np.int64)
    room = 64 * n
    other, depth = np.empty(room, dtype=np.int64), np.empty(room)
    count = 0
    for i in range(n):
        x, y = ideal_a[i, 0], ideal_a[i, 1]
        rx = b_from_a[0, 0] * x + b_from_a[0, 1] * y + b_from_a[0, 2]
        ry = b_from_a[1, 0] * x + b_from_a[1, 1] * y + b_from_a[1, 2]
        rz = b_from_a[2, 0] * x + b_from_a[2, 1] * y + b_from_a[2, 2]
        tx, ty, tz = b_from_a[0, 3], b_from_a[1, 3], b_from_a[2, 3]
        low, high = least, largest
        # In front of camera b: rz + r tz > 0.
        if tz < 0.0:
            high = min(high, (rz - _MIN_DEPTH) / -tz)
        elif rz < _MIN_DEPTH:
            low = max(low, (_MIN_DEPTH - rz) / max(tz, 1e-12))
        first[i + 1] = count
        if not low < high or rz + low * tz <= 0.0:
            continue
        ax, ay = (rx + low * tx) / (rz + low * tz), (ry + low * ty) / (rz + low * tz)
        bx, by = (rx + high * tx) / (rz + high * tz), (ry + high * ty) / (rz + high * tz)
        dx, dy = bx - ax, by - ay
        length = np.sqrt(dx * dx + dy * dy)
        if length < band:
            continue
        dx, dy = dx / length, dy / length
        for q in range(k):
            px, py = ideal_b[q, 0] - ax, ideal_b[q, 1] - ay
            if abs(px * dy - py * dx) > band:
                continue
            along = px * dx + py * dy
            if along < -band or along > length + band:
                continue
            along = min(max(along, 0.0), length)
            ux, uy = ax + along * dx, ay + along * dy
            # The inverse depth that projects there, by the larger component.
            fx, fy = tx - ux * tz, ty - uy * tz
            r = (ux * rz - rx) / fx if abs(fx) > abs(fy) else (uy * rz - ry) / fy
            if count == room:
                room *= 2
                more_other, more_depth = np.empty(room, dtype=np.int64), np.empty(room)
                more_other[:count] = other
                more_depth[:count] = depth
                other, depth = more_other, more_depth
            other[count] = q
            depth[count] = r
            count += 1
        first[i + 1] = count
    return first, other[:count], depth[:count]


@compiled
def _clear(
    first: NDArray[np.int64],
    other: NDArray[np.int64],
    distance: Array,
    pixels: Array,
    ratio: float,
    same_px: float,
) -> NDArray[np.int64]:
    """Return for each range its best pair, -1 where another place is nearly as good."""
    out = np.full(len(first) - 1, -1, dtype=np.int64)
    for i in range(len(first) - 1):
        best = -1
        for p in range(first[i], first[i + 1]):
            if best < 0 or distance[p] < distance[best]:
                best = p
        if best < 0:
            continue
        clear = True
        for p in range(first[i], first[i + 1]):
            dx = pixels[other[p], 0] - pixels[other[best], 0]
            dy = pixels[other[p], 1] - pixels[other[best], 1]
            if dx * dx + dy * dy > same_px * same_px and distance[best] >= ratio * distance[p]:
                clear = False
                break
        if clear:
            out[i] = best
    return out
