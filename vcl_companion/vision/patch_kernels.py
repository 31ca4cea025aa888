"""Compiled loops of patch tracking: patches warped, and found in a frame (IV-D; issue 4).

What they look like from the frame, and where they are expected, is in ``patch_views``.

A patch lies row by row in ``_WIDE`` columns, its own and two more: of the margin, or of nothing.
So does what is looked at of the frame; all loops run over whole rows of both, in single precision,
and the compiler takes many texels at once.

In the dark most of what differs between two images is noise, and a patch is none the less the
same: a score may be the correlation of what both would show without it.

Layout of the tables:
  texels (uint8), shelves (V, L, 3) int64: start, height, width of each pyramid level
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled, reordered
from vcl_companion.geometry.rotation import Array

Ints = NDArray[np.int64]
Texels = NDArray[np.uint8]
Singles = NDArray[np.float32]

HALF = 4
SIDE = 2 * HALF + 1
_WIDE = SIDE + 2
# Loops are over so many, a multiple of what any machine takes at once: the rows, and zeros.
_N_PATCH, _N_MARGINED = 112, 128
# By how much bilinear interpolation reduces the variance of white noise, on average.
_SMOOTHED = 4.0 / 9.0
# Noise makes gradients of its own, which tell of no shift. Half of the residual's is the patch's,
# half of that its central differences'; some of what is taken for texture is some all the same.
_GRADIENT_NOISE = 0.25
_LEAST_GRADIENT = 0.25
# Where a patch's far side is so many times farther than its middle, it is edge on.
_LEAST_DIVISOR = 0.5
_LEAST_SHARE = 0.125
# Of what varies in a patch so much is no noise, whatever the images as a whole say.
_LEAST_SIGNAL = 0.6
# Rounding in single precision stays within an image.
_ROUNDING_PX = 1e-3
# Why a patch was not found.
FOUND, OUTSIDE, FLAT, UNLIKE, WANDERED, UNSETTLED = 0, 1, 2, 3, 4, 5

# Where in the patch each number of a row-by-row table stands; 1 for those of the patch itself.
_AT = np.arange(_N_MARGINED)
_ACROSS = np.where(_AT < _WIDE**2, _AT % _WIDE - HALF - 1, 0).astype(np.float32)
_DOWN = np.where(_AT < _WIDE**2, _AT // _WIDE - HALF - 1, 0).astype(np.float32)
_OF_PATCH = ((_AT % _WIDE < SIDE) & (_AT < SIDE * _WIDE)).astype(np.float32)[:_N_PATCH]


@reordered
def _placed(
    u: float,
    v: float,
    width: int,
    back: Array,
    places: NDArray[np.int32],
    across: Singles,
    down: Singles,
) -> None:
    """Fill where texels of a patch and its margin are: place in the image, shares to the next."""
    u0, v0, wide = np.float32(u), np.float32(v), np.int32(width)
    a, b, c, d = np.float32(back[0]), np.float32(back[1]), np.float32(back[2]), np.float32(back[3])
    e, f, one = np.float32(back[4]), np.float32(back[5]), np.float32(1.0)
    for k in range(_N_MARGINED):
        i, j = _DOWN[k], _ACROSS[k]
        scaled = one / (one + e * j + f * i)
        x, y = u0 + (a * j + b * i) * scaled, v0 + (c * j + d * i) * scaled
        column, row = np.int32(x), np.int32(y)
        places[k] = row * wide + column
        across[k], down[k] = x - np.float32(column), y - np.float32(row)


@compiled
def warped(
    texels: Texels,
    shelves: Ints,
    key_u: float,
    key_v: float,
    back: Array,
    places: NDArray[np.int32],
    across: Singles,
    down: Singles,
    out: Singles,
) -> bool:
    """Fill grey levels of a keyframe around a pixel, by a homography.

    Args:
        texels: of all keyframes.
        shelves: (L, 3) the keyframe's pyramid.
        key_u: column of the patch's centre in the keyframe.
        key_v: its row.
        back: (6,) d(keyframe pixel) / d(patch pixel) at the centre, and the relative change
            per patch pixel of what divides it.
        places: (_N_MARGINED,) to work with, like the next two.
        across: likewise.
        down: likewise.
        out: (_WIDE * _WIDE or more,) the patch with a margin of one.

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
    least = 1.0 - reach * (abs(back[4]) + abs(back[5]))
    if not least > _LEAST_DIVISOR:
        return False
    shrunk = back.copy()
    for step in range(n_levels):
        start, height, width = shelves[level + step]
        shrink = 1.0 / (1 << (level + step))
        weight = np.float32(share if step == 1 else 1.0 - share)
        u, v = key_u * shrink, key_v * shrink
        for k in range(4):
            shrunk[k] = back[k] * shrink
        far_u = reach * (abs(shrunk[0]) + abs(shrunk[1])) / least + _ROUNDING_PX
        far_v = reach * (abs(shrunk[2]) + abs(shrunk[3])) / least + _ROUNDING_PX
        if not (u - far_u >= 0.0 and v - far_v >= 0.0):
            return False
        if not (u + far_u < width - 1.0 and v + far_v < height - 1.0):
            return False
        left, top = int(u - far_u), int(v - far_v)
        _placed(u - left, v - top, width, shrunk, places, across, down)
        # Not signed: numba looks out for negative positions otherwise.
        corner, one = np.uint64(start + top * width + left), np.uint64(1)
        below = corner + np.uint64(width)
        for k in range(_WIDE * _WIDE):
            at, under = corner + np.uint64(places[k]), below + np.uint64(places[k])
            near, next_ = np.float32(texels[at]), np.float32(texels[at + one])
            upper = near + across[k] * (next_ - near)
            near, next_ = np.float32(texels[under]), np.float32(texels[under + one])
            lower = near + across[k] * (next_ - near)
            grey = weight * (upper + down[k] * (lower - upper))
            out[k] = grey if step == 0 else out[k] + grey
    return True


@reordered
def _based(patch: Singles, basis: Singles, normal: Array) -> None:
    """Fill a patch and its gradients, each of zero mean, and the upper half of their products.

    Of zero mean, so that the bias drops out; zero beside the patch.
    """
    n, half = np.float32(SIDE * SIDE), np.float32(0.5)
    zero = np.float32(0.0)
    here, right, left = patch[_WIDE + 1 :], patch[_WIDE + 2 :], patch[_WIDE:]
    above, under = patch[1:], patch[2 * _WIDE + 1 :]
    t_sum, x_sum, y_sum = zero, zero, zero
    for k in range(_N_PATCH):
        t_sum += _OF_PATCH[k] * here[k]
        x_sum += _OF_PATCH[k] * (right[k] - left[k])
        y_sum += _OF_PATCH[k] * (under[k] - above[k])
    t_mean, x_mean, y_mean = t_sum / n, half * x_sum / n, half * y_sum / n
    tt, tx, ty, xx, xy, yy = zero, zero, zero, zero, zero, zero
    for k in range(_N_PATCH):
        t = _OF_PATCH[k] * (here[k] - t_mean)
        x = _OF_PATCH[k] * (half * (right[k] - left[k]) - x_mean)
        y = _OF_PATCH[k] * (half * (under[k] - above[k]) - y_mean)
        basis[0, k], basis[1, k], basis[2, k] = t, x, y
        tt += t * t
        tx += t * x
        ty += t * y
        xx += x * x
        xy += x * y
        yy += y * y
    normal[0, 0], normal[0, 1], normal[0, 2] = tt, tx, ty
    normal[1, 1], normal[1, 2], normal[2, 2] = xx, xy, yy


@compiled
def _cut(image: Texels, corner: int, width: int, out: Singles) -> None:
    """Fill the texels that a patch lies on, and one more to the right and below.

    Less the grey of the middle: of small numbers single precision loses little.
    """
    pivot = np.float32(image[corner + HALF * width + HALF])
    for r in range(SIDE + 1):
        at = corner + r * width
        # From zero on: numba looks out for negative positions otherwise.
        line, row = image[at : at + SIDE + 1], out[r * _WIDE : r * _WIDE + SIDE + 1]
        for c in range(SIDE + 1):
            row[c] = np.float32(line[c]) - pivot


@reordered
def _compared(
    texels: Singles, a: float, b: float, basis: Singles
) -> tuple[float, float, float, float, float]:
    """Return sums over a patch of the frame: grey, its square, its products with the basis.

    Args:
        texels: as ``_cut`` fills them.
        a: of a texel, how far to the right of the first the patch begins.
        b: how far below.
        basis: (3, _N_PATCH) zero beside the patch.
    """
    w00, w01 = np.float32((1.0 - a) * (1.0 - b)), np.float32(a * (1.0 - b))
    w10, w11 = np.float32((1.0 - a) * b), np.float32(a * b)
    zero = np.float32(0.0)
    s, s2, st, sx, sy = zero, zero, zero, zero, zero
    right, under, beyond = texels[1:], texels[_WIDE:], texels[_WIDE + 1 :]
    template, by_x, by_y = basis[0], basis[1], basis[2]
    for k in range(_N_PATCH):
        grey = w00 * texels[k] + w01 * right[k] + w10 * under[k] + w11 * beyond[k]
        own = _OF_PATCH[k] * grey
        s += own
        s2 += own * grey
        st += grey * template[k]
        sx += grey * by_x[k]
        sy += grey * by_y[k]
    return float(s), float(s2), float(st), float(sx), float(sy)


@compiled
def _widen(noises: Array, own: Array, greys: Array, status: Ints) -> None:
    """Take for texture only what is none of the noise's gradients.

    An alignment ends where the products of the patch's gradients with the residual are zero. What
    of these is noise moves that place, and counts in the normal matrix as if it had fixed it.

    Args:
        noises: (M, 3) xx xy yy of the pixels found; widened.
        own: (M, 2) variance of the shift across and down per variance of a grey level.
        greys: (M,) variance of the residual's grey levels.
        status: (M,) FOUND or why not.
    """
    found = np.flatnonzero(status == FOUND)
    if len(found) == 0:
        return
    # A quarter of them looks like its patch but for the noise.
    at = len(found) // 4
    lost = _GRADIENT_NOISE * SIDE * SIDE * np.partition(greys[found], at)[at]
    for i in found:
        more_x = 1.0 / max(1.0 - lost * own[i, 0], _LEAST_GRADIENT)
        more_y = 1.0 / max(1.0 - lost * own[i, 1], _LEAST_GRADIENT)
        noises[i, 0] *= more_x * more_x
        noises[i, 1] *= more_x * more_y
        noises[i, 2] *= more_y * more_y


@compiled
def align(
    views: Array,
    seen: NDArray[np.bool_],
    keyframe: Ints,
    key_pixels: Array,
    key_texels: Texels,
    shelves: Ints,
    key_noises: Array,
    image: Texels,
    levels: Ints,
    frame_noise: float,
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
        key_texels: of all keyframes.
        shelves: (V, L, 3) of all keyframes.
        key_noises: (V,) of their pixels, 1 sigma, grey levels.
        image: texels of the frame's pyramid.
        levels: (L, 3) shelves of the frame's pyramid.
        frame_noise: of its pixels, 1 sigma, grey levels.
        radii: (M,) how far around the prediction to search first, px of the full image;
            below one pixel of the level there is no search.
        rules: (9,) iterations; least score; how far an alignment may move from
            where it began, level px; px that count as settled; misplacement: base,
            per rad, per octave, px, and as a factor on what the residual says; 1 where the
            score leaves out noise, else 0.
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
    greys, own = np.zeros(m), np.zeros((m, 2))
    patch = np.zeros(_N_PATCH + 2 * _WIDE + 1, np.float32)
    basis = np.empty((3, _N_PATCH), np.float32)
    texels = np.zeros(_N_PATCH + _WIDE + 1, np.float32)
    places = np.empty(_N_MARGINED, np.int32)
    across, down = np.empty(_N_MARGINED, np.float32), np.empty(_N_MARGINED, np.float32)
    back = np.empty(6)
    normal, inverse = np.empty((3, 3)), np.empty((3, 3))
    forgiven = rules[8] * SIDE * SIDE
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
            key_texels, shelves[keyframe[i]], key_pixels[i, 0], key_pixels[i, 1], back,
            places, across, down, patch,
        ):  # fmt: skip
            continue
        start, height, width = levels[level]
        u0, v0 = view[3] / size, view[4] / size
        _based(patch, basis, normal)
        energy = normal[0, 0]
        # At half the size the variance of white noise is about a sixteenth.
        fewer = max(back[0] * back[3] - back[1] * back[2], 1.0)
        key_noise = forgiven * _SMOOTHED * (key_noises[keyframe[i]] / fewer) ** 2
        energy = max(energy - key_noise, _LEAST_SIGNAL * energy)
        noise = forgiven * (frame_noise / (size * size)) ** 2
        if not _inverted(normal, inverse):
            status[i] = FLAT
            continue
        u, v = u0, v0
        reach_px = radii[i] / size
        if reach_px >= 1.0:
            u, v, peak = _searched(
                image, start, height, width, u0, v0, math.ceil(reach_px), basis[0], energy, noise
            )
            if peak < 0.5 * rules[1]:
                status[i] = UNLIKE
                continue
        begin_u, begin_v = u, v
        cut = -1
        status[i] = UNSETTLED
        score, residual, smoothed = 0.0, 0.0, 1.0
        for iteration in range(int(rules[0]) + 1):
            if not (HALF <= u < width - HALF - 1 and HALF <= v < height - HALF - 1):
                status[i] = OUTSIDE
                break
            column, row = int(u), int(v)
            corner = start + (row - HALF) * width + column - HALF
            if corner != cut:
                cut = corner
                _cut(image, corner, width, texels)
            a, b = u - column, v - row
            w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
            smoothed = w00 * w00 + w01 * w01 + w10 * w10 + w11 * w11
            s, s2, st, sx, sy = _compared(texels, a, b, basis)
            spread = s2 - s * s / (SIDE * SIDE)
            gain = inverse[0, 0] * st + inverse[0, 1] * sx + inverse[0, 2] * sy
            ex = inverse[1, 0] * st + inverse[1, 1] * sx + inverse[1, 2] * sy
            ey = inverse[2, 0] * st + inverse[2, 1] * sx + inverse[2, 2] * sy
            signal = max(spread - noise * smoothed, _LEAST_SIGNAL * spread)
            score = min(st / math.sqrt(max(signal * energy, 1e-9)), 1.0)
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
        greys[i] = residual / (SIDE * SIDE - 4.0)
        own[i, 0], own[i, 1] = inverse[1, 1], inverse[2, 2]
        # Interpolating takes noise away pixel by pixel, and spreads it over the neighbours: what
        # the patch as a whole is off stays. The keyframe's is sampled at all sorts of places.
        variance = greys[i] / (0.5 * (smoothed + _SMOOTHED)) * size * size
        noises[i, 0], noises[i, 1] = variance * inverse[1, 1], variance * inverse[1, 2]
        noises[i, 2] = variance * inverse[2, 2]
        half_angle, octaves = view[15], view[16]
        spread = (
            (rules[4] * size) ** 2 + (2.0 * rules[5] * half_angle) ** 2 + (rules[6] * octaves) ** 2
        )
        misplaced[i, 0] = misplaced[i, 2] = spread
    _widen(noises, own, greys, status)
    misplaced += rules[7] * rules[7] * noises
    return pixels, noises, misplaced, scores, status


@reordered
def _searched(
    image: Texels,
    start: int,
    height: int,
    width: int,
    u0: float,
    v0: float,
    radius: int,
    template: Singles,
    energy: float,
    noise: float,
) -> tuple[float, float, float]:
    """Return the pixel near (u0, v0) that correlates best with a zero-mean patch, and its score.

    The score is of what both would show without noise: ``energy`` of the patch is, and of what
    it is compared with ``noise`` is taken.
    Whole steps around the prediction, so that a right one is not moved. Every step through the
    window is a number of the same line: those at the ends of its rows, where a patch would go on
    in the next one, are counted and not looked at.
    """
    column, row = math.floor(u0 + 0.5), math.floor(v0 + 0.5)
    left, right = max(column - radius, HALF), min(column + radius, width - HALF - 1)
    top, bottom = max(row - radius, HALF), min(row + radius, height - HALF - 1)
    if left > right or top > bottom:
        return u0, v0, -2.0
    wide, high = right - left + SIDE, bottom - top + SIDE
    n = (bottom - top + 1) * wide
    window = np.zeros(high * wide + SIDE, np.float32)
    # Less some grey of it, so that all sums of whole numbers are exact.
    pivot = np.float32(image[start + (top + bottom) // 2 * width + (left + right) // 2])
    for r in range(high):
        at = start + (top - HALF + r) * width + left - HALF
        line, row_out = image[at : at + wide], window[r * wide : (r + 1) * wide]
        for c in range(wide):
            row_out[c] = np.float32(line[c]) - pivot
    sums, squares = np.zeros(n, np.float32), np.zeros(n, np.float32)
    products = np.zeros(n, np.float32)
    for r in range(SIDE):
        greys, weights = window[r * wide :], template[r * _WIDE :]
        for k in range(n):
            s, s2, st = sums[k], squares[k], products[k]
            for c in range(SIDE):
                grey = greys[k + c]
                s += grey
                s2 += grey * grey
                st += grey * weights[c]
            sums[k], squares[k], products[k] = s, s2, st
    best, best_u, best_v, most = -2.0, u0, v0, 0.0
    for i in range(bottom - top + 1):
        for j in range(right - left + 1):
            k = i * wide + j
            total = float(sums[k])
            spread = float(squares[k]) - total * total / (SIDE * SIDE)
            score = float(products[k]) / math.sqrt(max(spread * energy, 1e-9))
            if score > best:
                best, best_u, best_v = score, float(left + j), float(top + i)
                most = spread
    return best_u, best_v, best * math.sqrt(most / max(most - noise, _LEAST_SIGNAL * most, 1e-9))


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
