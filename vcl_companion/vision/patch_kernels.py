"""Compiled loops of patch tracking: patches warped, and found in a frame (IV-D; issue 4).

What they look like from the frame, and where they are expected, is in ``patch_views``.

Layout of the tables:
  texels (uint8), shelves (V, L, 3) int64: start, height, width of each pyramid level
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.compiled import compiled

Ints = NDArray[np.int64]
Texels = NDArray[np.uint8]

HALF = 4
SIDE = 2 * HALF + 1
# By how much bilinear interpolation reduces the variance of white noise, on average.
_SMOOTHED = 4.0 / 9.0
# Where a patch's far side is so many times farther than its middle, it is edge on.
_LEAST_DIVISOR = 0.5
_LEAST_SHARE = 0.125
# Why a patch was not found.
FOUND, OUTSIDE, FLAT, UNLIKE, WANDERED, UNSETTLED = 0, 1, 2, 3, 4, 5


@compiled
def sampled(texels: Texels, start: int, height: int, width: int, u: float, v: float) -> float:
    """Return the grey level at a pixel of one pyramid level, bilinear; the caller keeps inside."""
    column, row = int(u), int(v)
    a, b = u - column, v - row
    # Not signed: numba looks out for negative positions otherwise.
    at, one = np.uint64(start + row * width + column), np.uint64(1)
    below = at + np.uint64(width)
    top = texels[at] * (1.0 - a) + texels[at + one] * a
    bottom = texels[below] * (1.0 - a) + texels[below + one] * a
    return float(top * (1.0 - b) + bottom * b)


@compiled
def warped(
    texels: Texels, shelves: Ints, key_u: float, key_v: float, back: Array, out: Array
) -> bool:
    """Fill (SIDE + 2, SIDE + 2) grey levels of a keyframe around a pixel, by a homography.

    Args:
        texels: of all keyframes.
        shelves: (L, 3) the keyframe's pyramid.
        key_u: column of the patch's centre in the keyframe.
        key_v: its row.
        back: (6,) d(keyframe pixel) / d(patch pixel) at the centre, and the relative change
            per patch pixel of what divides it.
        out: the patch with a margin of one.

    Returns:
        Whether all of it lies inside the keyframe.
    """
    scale = math.sqrt(abs(back[0] * back[3] - back[1] * back[2]))
    depth = min(max(math.log2(scale), 0.0), len(shelves) - 1.0)
    level = min(int(depth), len(shelves) - 2) if len(shelves) > 1 else 0
    share = depth - level
    # A little of another level is no other patch, and takes as long as half of it.
    if share < _LEAST_SHARE:
        share = 0.0
    elif share > 1.0 - _LEAST_SHARE:
        level, share = level + 1, 0.0
    n_levels = 2 if share > 0.0 else 1
    reach = HALF + 1
    e, f = back[4], back[5]
    least = 1.0 - reach * (abs(e) + abs(f))
    if not least > _LEAST_DIVISOR:
        return False
    for step in range(n_levels):
        start, height, width = shelves[level + step]
        shrink = 1.0 / (1 << (level + step))
        weight = share if step == 1 else 1.0 - share
        su, sv = key_u * shrink, key_v * shrink
        a, b, c, d = back[0] * shrink, back[1] * shrink, back[2] * shrink, back[3] * shrink
        far_u, far_v = reach * (abs(a) + abs(b)) / least, reach * (abs(c) + abs(d)) / least
        if not (su - far_u >= 0.0 and sv - far_v >= 0.0):
            return False
        if not (su + far_u < width - 1.0 and sv + far_v < height - 1.0):
            return False
        for i in range(-reach, reach + 1):
            for j in range(-reach, reach + 1):
                scaled = 1.0 / (1.0 + e * j + f * i)
                u, v = su + (a * j + b * i) * scaled, sv + (c * j + d * i) * scaled
                grey = sampled(texels, start, height, width, u, v)
                if step == 0:
                    out[i + reach, j + reach] = weight * grey
                else:
                    out[i + reach, j + reach] += weight * grey
    return True


@compiled
def align(
    views: Array,
    seen: NDArray[np.bool_],
    keyframe: Ints,
    key_pixels: Array,
    texels: Texels,
    shelves: Ints,
    image: Texels,
    levels: Ints,
    radii: Array,
    rules: Array,
    least_level: int,
) -> tuple[Array, Array, Array, Array, Ints]:
    """Find patches in a frame.

    Inverse compositional alignment of translation, gain and bias: the frame is
    gain * (patch + gradient . shift) + bias, least squares in all four, whose
    normal matrix is the warped patch's own (Baker and Matthews, IJCV 2004).

    Args:
        views: (M, N_VIEW) what they look like from the frame, and
        seen: (M,) whether they do (``patch_views.viewed``).
        keyframe: (M,) where each patch is cut from, and
        key_pixels: (M, 2) at which pixel there.
        texels: of all keyframes.
        shelves: (V, L, 3) of all keyframes.
        image: texels of the frame's pyramid.
        levels: (L, 3) shelves of the frame's pyramid.
        radii: (M,) how far around the prediction to search first, px of the full image;
            below one pixel of the level there is no search.
        rules: (8,) iterations; least score; how far an alignment may move from
            where it began, level px; px that count as settled; misplacement: base,
            per rad, per octave, px, and as a factor on what the residual says.
        least_level: pyramid level to align on; coarser for landmarks that would
            have to be magnified.

    Returns:
        (M, 2) pixel found, NaN where there is none; (M, 3) xx xy yy of its noise by the grey
        levels' residual, px^2; (M, 3) the same of its misplacement; (M,) score; (M,) FOUND
        or why not.
    """
    m = len(views)
    pixels = np.full((m, 2), np.nan)
    noises, misplaced = np.zeros((m, 3)), np.zeros((m, 3))
    scores, status = np.zeros(m), np.full(m, OUTSIDE)
    patch = np.empty((SIDE + 2, SIDE + 2))
    basis = np.empty((3, SIDE, SIDE))
    back = np.empty(6)
    normal, inverse = np.empty((3, 3)), np.empty((3, 3))
    for i in range(m):
        if not seen[i]:
            continue
        view = views[i]
        det = view[9] * view[12] - view[10] * view[11]
        # Magnified patches are blurred: look at a smaller frame instead.
        level = least_level
        while level + 1 < len(levels) and det * 0.25**level > 2.0:
            level += 1
        size = float(1 << level)
        back[0], back[1] = size * view[12] / det, -size * view[10] / det
        back[2], back[3] = -size * view[11] / det, size * view[9] / det
        back[4], back[5] = size * view[13], size * view[14]
        if not warped(
            texels, shelves[keyframe[i]], key_pixels[i, 0], key_pixels[i, 1], back, patch
        ):
            continue
        start, height, width = levels[level]
        u0, v0 = view[3] / size, view[4] / size
        mean = 0.0
        for r in range(SIDE):
            for c in range(SIDE):
                mean += patch[r + 1, c + 1]
        mean /= SIDE * SIDE
        gx_mean, gy_mean = 0.0, 0.0
        for r in range(SIDE):
            for c in range(SIDE):
                basis[0, r, c] = patch[r + 1, c + 1] - mean
                basis[1, r, c] = 0.5 * (patch[r + 1, c + 2] - patch[r + 1, c])
                basis[2, r, c] = 0.5 * (patch[r + 2, c + 1] - patch[r, c + 1])
                gx_mean += basis[1, r, c]
                gy_mean += basis[2, r, c]
        gx_mean /= SIDE * SIDE
        gy_mean /= SIDE * SIDE
        # With all three of zero mean the bias drops out.
        normal[:] = 0.0
        for r in range(SIDE):
            for c in range(SIDE):
                basis[1, r, c] -= gx_mean
                basis[2, r, c] -= gy_mean
                t, gx, gy = basis[0, r, c], basis[1, r, c], basis[2, r, c]
                normal[0, 0] += t * t
                normal[0, 1] += t * gx
                normal[0, 2] += t * gy
                normal[1, 1] += gx * gx
                normal[1, 2] += gx * gy
                normal[2, 2] += gy * gy
        energy = normal[0, 0]
        if not _inverted(normal, inverse):
            status[i] = FLAT
            continue
        u, v = u0, v0
        reach_px = radii[i] / size
        if reach_px >= 1.0:
            u, v, peak = _searched(
                image, start, height, width, u0, v0, math.ceil(reach_px), basis[0], energy
            )
            if peak < 0.5 * rules[1]:
                status[i] = UNLIKE
                continue
        begin_u, begin_v = u, v
        status[i] = UNSETTLED
        score, residual, smoothed = 0.0, 0.0, 1.0
        for iteration in range(int(rules[0]) + 1):
            if not (HALF <= u < width - HALF - 1 and HALF <= v < height - HALF - 1):
                status[i] = OUTSIDE
                break
            s, s2, st, sx, sy = 0.0, 0.0, 0.0, 0.0, 0.0
            column, row = int(u), int(v)
            a, b = u - column, v - row
            w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            smoothed = w00 * w00 + w01 * w01 + w10 * w10 + w11 * w11
            for r in range(SIDE):
                at = start + (row + r - HALF) * width + column - HALF
                # From zero on: numba looks out for negative positions otherwise.
                top, bottom = image[at : at + SIDE + 1], image[at + width : at + width + SIDE + 1]
                for c in range(SIDE):
                    grey = w00 * top[c] + w01 * top[c + 1] + w10 * bottom[c] + w11 * bottom[c + 1]
                    s += grey
                    s2 += grey * grey
                    st += grey * basis[0, r, c]
                    sx += grey * basis[1, r, c]
                    sy += grey * basis[2, r, c]
            spread = s2 - s * s / (SIDE * SIDE)
            gain = inverse[0, 0] * st + inverse[0, 1] * sx + inverse[0, 2] * sy
            ex = inverse[1, 0] * st + inverse[1, 1] * sx + inverse[1, 2] * sy
            ey = inverse[2, 0] * st + inverse[2, 1] * sx + inverse[2, 2] * sy
            score = st / math.sqrt(max(spread * energy, 1e-9))
            if not gain > 0.05:
                status[i] = UNLIKE
                break
            du, dv = ex / gain, ey / gain
            residual = max(spread - gain * st - ex * sx - ey * sy, 0.0) / (gain * gain)
            if du * du + dv * dv < rules[3] * rules[3]:
                status[i] = FOUND
                u, v = u - du, v - dv
                break
            if iteration == int(rules[0]):
                break
            length = math.sqrt(du * du + dv * dv)
            if length > 1.0:
                du, dv = du / length, dv / length
            u, v = u - du, v - dv
            if (u - begin_u) ** 2 + (v - begin_v) ** 2 > rules[2] * rules[2]:
                status[i] = WANDERED
                break
        scores[i] = score
        if status[i] == FOUND and score < rules[1]:
            status[i] = UNLIKE
        if status[i] != FOUND:
            continue
        pixels[i, 0], pixels[i, 1] = u * size, v * size
        # Interpolating takes noise away pixel by pixel, and spreads it over the neighbours: what
        # the patch as a whole is off stays. The keyframe's is sampled at all sorts of places.
        variance = residual / (SIDE * SIDE - 4.0) / (0.5 * (smoothed + _SMOOTHED)) * size * size
        noises[i, 0], noises[i, 1] = variance * inverse[1, 1], variance * inverse[1, 2]
        noises[i, 2] = variance * inverse[2, 2]
        half_angle, octaves = view[15], view[16]
        spread = (
            (rules[4] * size) ** 2 + (2.0 * rules[5] * half_angle) ** 2 + (rules[6] * octaves) ** 2
        )
        share = rules[7] * rules[7]
        misplaced[i, 0] = spread + share * noises[i, 0]
        misplaced[i, 1] = share * noises[i, 1]
        misplaced[i, 2] = spread + share * noises[i, 2]
    return pixels, noises, misplaced, scores, status


@compiled
def _searched(
    image: Texels,
    start: int,
    height: int,
    width: int,
    u0: float,
    v0: float,
    radius: int,
    patch: Array,
    energy: float,
) -> tuple[float, float, float]:
    """Return the pixel near (u0, v0) that correlates best with a zero-mean patch, and its score.

    Whole steps around the prediction, so that a right one is not moved.
    """
    best, best_u, best_v = -2.0, u0, v0
    column, row = math.floor(u0 + 0.5), math.floor(v0 + 0.5)
    for dv in range(-radius, radius + 1):
        centre_v = row + dv
        if centre_v < HALF or centre_v >= height - HALF:
            continue
        for du in range(-radius, radius + 1):
            centre_u = column + du
            if centre_u < HALF or centre_u >= width - HALF:
                continue
            s, s2 = 0, 0
            st = 0.0
            for r in range(SIDE):
                at = start + (centre_v + r - HALF) * width + centre_u - HALF
                line = image[at : at + SIDE]
                for c in range(SIDE):
                    grey = int(line[c])
                    s += grey
                    s2 += grey * grey
                    st += grey * patch[r, c]
            spread = s2 - s * s / (SIDE * SIDE)
            score = st / math.sqrt(max(spread * energy, 1e-9))
            if score > best:
                best, best_u, best_v = score, float(centre_u), float(centre_v)
    return best_u, best_v, best


@compiled
def _inverted(normal: Array, out: Array) -> bool:
    """Fill the inverse of a symmetric (3, 3) matrix, upper triangle given; False if singular."""
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 2]
    d, e, f = normal[1, 1], normal[1, 2], normal[2, 2]
    out[0, 0], out[0, 1], out[0, 2] = d * f - e * e, c * e - b * f, b * e - c * d
    out[1, 1], out[1, 2], out[2, 2] = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * out[0, 0] + b * out[0, 1] + c * out[0, 2]
    # Contrast below a few grey levels, or an edge without an end.
    if not (a > 200.0 and determinant > 2e-3 * a * d * f and d > 0.0 and f > 0.0):
        return False
    for r in range(3):
        for s in range(r, 3):
            out[r, s] /= determinant
            out[s, r] = out[r, s]
    return True
