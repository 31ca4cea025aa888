"""Compiled loops of patch tracking: which landmarks, warp, align (IV-D; issue 4).

A landmark is anchored in a keyframe: an ideal image point (x, y) there with an
inverse depth linear in it, r + b dx + c dy, which is what a plane looks like.
With frame_from_key (R, t) it appears in the frame along R (x, y, 1) + t r; the
derivative of that by (x, y), between the slopes of both lenses, is the local
affine map of the two raw images; over a patch of a surface that recedes fast,
as the ground does, the foreshortening itself changes, so a patch is warped by
the homography of its plane: by an affine map alone a street's patches are 0.06 px
and more off, all to the same side, and the map is tilted.

Layout of the tables (all float64 unless said):
  planes (A, 9): x, y, r, b, c of each anchor, ideal units and 1/m, then the four
    d(ideal) / d(pixel) of the keyframe's lens there
  lens (10,): model (0 none, 1 radial-tangential, 2 equidistant), fx, fy, cx, cy, 5 coefficients
  reach: largest squared ideal radius that the lens shows
  transforms (V, 3, 4): frame_from_key of each keyframe's camera
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

N_LENS = 10
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
def bent(lens: Array, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Return pixel u, v of an ideal point, and its slopes du/dx, du/dy, dv/dx, dv/dy."""
    if lens[0] == 1.0:
        k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        growth = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)
        a = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        b = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        ax = radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x
        ay = 2.0 * x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y
        by = radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x
        bx = ay
    elif lens[0] == 2.0:
        r = math.sqrt(x * x + y * y)
        theta = math.atan(r)
        t2 = theta * theta
        poly = 1.0 + t2 * (lens[5] + t2 * (lens[6] + t2 * (lens[7] + t2 * lens[8])))
        slope = 1.0 + t2 * (
            3.0 * lens[5] + t2 * (5.0 * lens[6] + t2 * (7.0 * lens[7] + t2 * 9.0 * lens[8]))
        )
        scale, pull = 1.0, 0.0
        if r > 1e-6:
            scale = theta * poly / r
            pull = (slope / (1.0 + r * r) - scale) / (r * r)
        a, b = x * scale, y * scale
        ax, ay, by = scale + x * x * pull, x * y * pull, scale + y * y * pull
        bx = ay
    else:
        a, b, ax, ay, bx, by = x, y, 1.0, 0.0, 0.0, 1.0
    fx, fy = lens[1], lens[2]
    return a * fx + lens[3], b * fy + lens[4], ax * fx, ay * fx, bx * fy, by * fy


@compiled
def seen_from(plane: Array, lens: Array, reach: float, transform: Array, out: Array) -> bool:
    """Fill what one anchor looks like from a frame; False where it cannot be seen.

    ``out`` (15,): ideal x, y; 1/depth in the frame; pixel u, v; slopes of the
    lens there (4); the affine map d(frame pixel) / d(keyframe pixel) (4); how the
    keyframe's depth of the plane over the frame's changes, relatively, per pixel
    of the frame (2).
    """
    x, y, r, b, c = plane[0], plane[1], plane[2], plane[3], plane[4]
    q0 = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] + transform[0, 3] * r
    q1 = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] + transform[1, 3] * r
    q2 = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] + transform[2, 3] * r
    if not (q2 > 1e-3 and r > 1e-6):
        return False
    ideal_x, ideal_y = q0 / q2, q1 / q2
    if not ideal_x * ideal_x + ideal_y * ideal_y < reach:
        return False
    u, v, ux, uy, vx, vy = bent(lens, ideal_x, ideal_y)
    # d(ideal in the frame) / d(ideal in the keyframe)
    q0x, q0y = transform[0, 0] + transform[0, 3] * b, transform[0, 1] + transform[0, 3] * c
    q1x, q1y = transform[1, 0] + transform[1, 3] * b, transform[1, 1] + transform[1, 3] * c
    q2x, q2y = transform[2, 0] + transform[2, 3] * b, transform[2, 1] + transform[2, 3] * c
    hxx, hxy = (q0x - ideal_x * q2x) / q2, (q0y - ideal_x * q2y) / q2
    hyx, hyy = (q1x - ideal_y * q2x) / q2, (q1y - ideal_y * q2y) / q2
    ixx, ixy, iyx, iyy = plane[5], plane[6], plane[7], plane[8]
    mxx, mxy = ux * hxx + uy * hyx, ux * hxy + uy * hyy
    myx, myy = vx * hxx + vy * hyx, vx * hxy + vy * hyy
    out[0], out[1], out[2], out[3], out[4] = ideal_x, ideal_y, r / q2, u, v
    out[5], out[6], out[7], out[8] = ux, uy, vx, vy
    out[9], out[10] = mxx * ixx + mxy * iyx, mxx * ixy + mxy * iyy
    out[11], out[12] = myx * ixx + myy * iyx, myx * ixy + myy * iyy
    # The last row of the inverse homography, as one over its value at the point.
    gx, gy, g1 = q1x * q2y - q2x * q1y, q2x * q0y - q0x * q2y, q0x * q1y - q1x * q0y
    weight = (gx * ideal_x + gy * ideal_y + g1) * (ux * vy - uy * vx)
    if not abs(weight) > 1e-12:
        return False
    out[13], out[14] = (vy * gx - vx * gy) / weight, (ux * gy - uy * gx) / weight
    # A patch seen from behind, or edge on, says nothing.
    return bool(out[9] * out[12] - out[10] * out[11] > 1e-3)


@compiled
def change_of_view(plane: Array, transform: Array) -> tuple[float, float]:
    """Return how an anchor's line of sight changes: the sine of half the angle, log2 of nearness.

    Nearness is the anchor's distance from the keyframe over that from the frame.
    """
    x, y, r = plane[0], plane[1], plane[2]
    d0 = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2]
    d1 = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2]
    d2 = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2]
    q0, q1, q2 = d0 + transform[0, 3] * r, d1 + transform[1, 3] * r, d2 + transform[2, 3] * r
    then2, now2 = d0 * d0 + d1 * d1 + d2 * d2, q0 * q0 + q1 * q1 + q2 * q2
    cosine = (d0 * q0 + d1 * q1 + d2 * q2) / math.sqrt(then2 * now2)
    return math.sqrt(max(0.5 - 0.5 * cosine, 0.0)), 0.5 * math.log2(then2 / now2)


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
def choose(
    first: Ints,
    keyframe: Ints,
    planes: Array,
    spread: Array,
    texture: Array,
    lens: Array,
    reach: float,
    transforms: Array,
    cam_from_world: Array,
    body_from_cam: Array,
    prior: Array,
    image: Array,
    rules: Array,
    wanted: int,
) -> tuple[Ints, Array, int]:
    """Choose the landmarks that fix the pose best, and the keyframe to take each of them from.

    A landmark's worth is its share of what all landmarks in view together know
    of the pose (its leverage), which weighs pixel noise, change of view and the
    landmark's own error; the best of each cell of the image come before the
    second best, so that they are spread over it.

    Args:
        first: (N + 1,) where each landmark's anchors begin.
        keyframe: (A,) of each anchor.
        planes: see the module.
        lens: of the frame.
        reach: of that lens.
        transforms: to the frame, see the module.
        spread: (A, 6) xx xy xz yy yz zz of each anchor's own error, world axes, m^2.
        texture: (A, 3) xx, xy, yy of the summed squared gradient of its patch.
        cam_from_world: (3, 3) rotation.
        body_from_cam: (3, 4).
        prior: (6, 6) covariance of the predicted pose, local.
        image: (3,) width, height, and the margin where no patch fits, px.
        rules: (7,) cell side px; grey noise; base, per rad, per octave misplacement px;
            most octaves nearer (magnified) and farther that are of use.
        wanted: how many, at most.

    Returns:
        (K,) anchors, best first; (K,) three sigma of where each will appear, px; how many
        landmarks were there to choose from.
    """
    n = len(first) - 1
    anchors, cells = np.empty(n, np.int64), np.empty(n, np.int64)
    jacobians, informations, worth = np.empty((n, 12)), np.empty((n, 3)), np.empty(n)
    view = np.empty(15)
    j_cam, j_pose = np.empty((2, 3)), np.empty((2, 6))
    total = np.zeros((6, 6))
    columns, rows = int(image[0] / rules[0]) + 1, int(image[1] / rules[0]) + 1
    margin = image[2]
    count = 0
    for j in range(n):
        best, least = -1, np.inf
        for a in range(first[j], first[j + 1]):
            half_angle, octaves = change_of_view(planes[a], transforms[keyframe[a]])
            if octaves > rules[5] or octaves < -rules[6] or half_angle > 0.7:
                continue
            change2 = (2.0 * rules[3] * half_angle) ** 2 + (rules[4] * octaves) ** 2
            if change2 < least:
                best, least = a, change2
        if best < 0:
            continue
        if not seen_from(planes[best], lens, reach, transforms[keyframe[best]], view):
            continue
        u, v = view[3], view[4]
        if not (margin <= u < image[0] - margin and margin <= v < image[1] - margin):
            continue
        gxx, gxy, gyy = texture[best, 0], texture[best, 1], texture[best, 2]
        det = gxx * gyy - gxy * gxy
        if not det > 1e-3 * gxx * gyy:
            continue
        # Pixel noise in the keyframe's axes, carried over.
        noise = rules[1] ** 2 / det
        nxx, nxy, nyy = noise * gyy, -noise * gxy, noise * gxx
        misplaced = rules[2] ** 2 + least
        b0, b1, b2, b3 = view[9], view[10], view[11], view[12]
        cxx = b0 * b0 * nxx + 2.0 * b0 * b1 * nxy + b1 * b1 * nyy + misplaced
        cxy = b0 * b2 * nxx + (b0 * b3 + b1 * b2) * nxy + b1 * b3 * nyy
        cyy = b2 * b2 * nxx + 2.0 * b2 * b3 * nxy + b3 * b3 * nyy + misplaced
        _by_cam(view, j_cam)
        x0 = _across(j_cam[0], cam_from_world, 0)
        x1 = _across(j_cam[0], cam_from_world, 1)
        x2 = _across(j_cam[0], cam_from_world, 2)
        y0 = _across(j_cam[1], cam_from_world, 0)
        y1 = _across(j_cam[1], cam_from_world, 1)
        y2 = _across(j_cam[1], cam_from_world, 2)
        m = spread[best]
        mx0 = m[0] * x0 + m[1] * x1 + m[2] * x2
        mx1 = m[1] * x0 + m[3] * x1 + m[4] * x2
        mx2 = m[2] * x0 + m[4] * x1 + m[5] * x2
        cxx += x0 * mx0 + x1 * mx1 + x2 * mx2
        cxy += y0 * mx0 + y1 * mx1 + y2 * mx2
        cyy += (
            m[0] * y0 * y0 + m[3] * y1 * y1 + m[5] * y2 * y2
            + 2.0 * (m[1] * y0 * y1 + m[2] * y0 * y2 + m[4] * y1 * y2)
        )  # fmt: skip
        det = cxx * cyy - cxy * cxy
        wxx, wxy, wyy = cyy / det, -cxy / det, cxx / det
        _by_pose(view, body_from_cam, j_cam, j_pose)
        for c in range(6):
            left = wxx * j_pose[0, c] + wxy * j_pose[1, c]
            right = wxy * j_pose[0, c] + wyy * j_pose[1, c]
            for d in range(c + 1):
                total[c, d] += left * j_pose[0, d] + right * j_pose[1, d]
            jacobians[count, c], jacobians[count, 6 + c] = j_pose[0, c], j_pose[1, c]
        anchors[count] = best
        informations[count, 0], informations[count, 1], informations[count, 2] = wxx, wxy, wyy
        cells[count] = int(v / rules[0]) * columns + int(u / rules[0])
        count += 1
    if count == 0:
        return anchors[:0], worth[:0], 0
    for c in range(6):
        total[c, c] = total[c, c] * (1.0 + 1e-6) + 1e-12
        for d in range(c):
            total[d, c] = total[c, d]
    covariance = np.linalg.inv(total)
    for i in range(count):
        xx, xy, yy = 0.0, 0.0, 0.0
        for c in range(6):
            left, right = 0.0, 0.0
            for d in range(6):
                left += covariance[c, d] * jacobians[i, d]
                right += covariance[c, d] * jacobians[i, 6 + d]
            xx += jacobians[i, c] * left
            xy += jacobians[i, c] * right
            yy += jacobians[i, 6 + c] * right
        w = informations[i]
        worth[i] = w[0] * xx + 2.0 * w[1] * xy + w[2] * yy
    order = np.argsort(-worth[:count])
    rank = np.empty(count, np.int64)
    taken = np.zeros(columns * rows, np.int64)
    for i in order:
        rank[i] = taken[cells[i]]
        taken[cells[i]] += 1
    size = min(wanted, count)
    chosen, radii = np.empty(size, np.int64), np.empty(size)
    # The best of every cell first, then the second best...: a stable sort keeps their order.
    turns = order[np.argsort(rank[order], kind="mergesort")]
    for k in range(size):
        i = turns[k]
        chosen[k] = anchors[i]
        apart = 0.0
        for c in range(6):
            for d in range(6):
                apart += prior[c, d] * (
                    jacobians[i, c] * jacobians[i, d] + jacobians[i, 6 + c] * jacobians[i, 6 + d]
                )
        # The larger axis of it holds at most all of it.
        radii[k] = 3.0 * math.sqrt(max(apart, 0.0))
    return chosen, radii, count


@compiled
def _across(row: Array, matrix: Array, column: int) -> float:
    """Return one element of a (3,) row times a (3, 3) matrix."""
    return float(
        row[0] * matrix[0, column] + row[1] * matrix[1, column] + row[2] * matrix[2, column]
    )


@compiled
def _by_cam(view: Array, out: Array) -> None:
    """Fill (2, 3) d(pixel) / d(point in camera axes)."""
    x, y, inverse = view[0], view[1], view[2]
    for r in range(2):
        sx, sy = view[5 + 2 * r], view[6 + 2 * r]
        out[r, 0], out[r, 1] = sx * inverse, sy * inverse
        out[r, 2] = -(sx * x + sy * y) * inverse


@compiled
def _by_pose(view: Array, body_from_cam: Array, j_cam: Array, out: Array) -> None:
    """Fill (2, 6) d(pixel) / d(local perturbation of the body)."""
    _by_cam(view, j_cam)
    z = 1.0 / view[2]
    x, y = view[0] * z, view[1] * z
    p = (
        body_from_cam[0, 0] * x + body_from_cam[0, 1] * y + body_from_cam[0, 2] * z
        + body_from_cam[0, 3],
        body_from_cam[1, 0] * x + body_from_cam[1, 1] * y + body_from_cam[1, 2] * z
        + body_from_cam[1, 3],
        body_from_cam[2, 0] * x + body_from_cam[2, 1] * y + body_from_cam[2, 2] * z
        + body_from_cam[2, 3],
    )  # fmt: skip
    for r in range(2):
        b0 = (
            j_cam[r, 0] * body_from_cam[0, 0]
            + j_cam[r, 1] * body_from_cam[0, 1]
            + j_cam[r, 2] * body_from_cam[0, 2]
        )
        b1 = (
            j_cam[r, 0] * body_from_cam[1, 0]
            + j_cam[r, 1] * body_from_cam[1, 1]
            + j_cam[r, 2] * body_from_cam[1, 2]
        )
        b2 = (
            j_cam[r, 0] * body_from_cam[2, 0]
            + j_cam[r, 1] * body_from_cam[2, 1]
            + j_cam[r, 2] * body_from_cam[2, 2]
        )
        out[r, 0], out[r, 1], out[r, 2] = -b0, -b1, -b2
        # j_body @ skew(p)
        out[r, 3] = b1 * p[2] - b2 * p[1]
        out[r, 4] = b2 * p[0] - b0 * p[2]
        out[r, 5] = b0 * p[1] - b1 * p[0]


@compiled
def align(
    chosen: Ints,
    keyframe: Ints,
    planes: Array,
    key_pixels: Array,
    texels: Texels,
    shelves: Ints,
    lens: Array,
    reach: float,
    transforms: Array,
    image: Texels,
    levels: Ints,
    radii: Array,
    rules: Array,
    least_level: int,
) -> tuple[Array, Array, Array, Array, Array, Array, Ints]:
    """Find the patches of chosen anchors in a frame.

    Inverse compositional alignment of translation, gain and bias: the frame is
    gain * (patch + gradient . shift) + bias, least squares in all four, whose
    normal matrix is the warped patch's own (Baker and Matthews, IJCV 2004).

    Args:
        chosen: (M,) anchors.
        keyframe: (A,) of each anchor.
        planes: see the module.
        key_pixels: (A, 2) of each anchor.
        texels: of all keyframes.
        shelves: (V, L, 3) of all keyframes.
        lens: of the frame.
        reach: of that lens.
        transforms: to the frame, see the module.
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
        (M, 4) pixel by the prediction, pixel found; (M, 2) ideal point of the latter;
        (M, 2, 2) slopes of the lens there; (M, 3) xx xy yy of its noise by the grey
        levels' residual, px^2; (M, 3) the same of its misplacement; (M, 2) score and
        px per level px; (M,) FOUND or why not.
    """
    m = len(chosen)
    pixels, ideals, slopes = np.full((m, 4), np.nan), np.zeros((m, 2)), np.zeros((m, 2, 2))
    noises, misplaced = np.zeros((m, 3)), np.zeros((m, 3))
    marks, status = np.zeros((m, 2)), np.full(m, OUTSIDE)
    view = np.empty(15)
    patch = np.empty((SIDE + 2, SIDE + 2))
    basis = np.empty((3, SIDE, SIDE))
    back = np.empty(6)
    normal, inverse = np.empty((3, 3)), np.empty((3, 3))
    for i in range(m):
        anchor = chosen[i]
        k = keyframe[anchor]
        if not seen_from(planes[anchor], lens, reach, transforms[k], view):
            continue
        det = view[9] * view[12] - view[10] * view[11]
        # Magnified patches are blurred: look at a smaller frame instead.
        level = least_level
        while level + 1 < len(levels) and det * 0.25**level > 2.0:
            level += 1
        size = float(1 << level)
        back[0], back[1] = size * view[12] / det, -size * view[10] / det
        back[2], back[3] = -size * view[11] / det, size * view[9] / det
        back[4], back[5] = size * view[13], size * view[14]
        pixels[i, 0], pixels[i, 1], marks[i, 1] = view[3], view[4], size
        if not warped(
            texels, shelves[k], key_pixels[anchor, 0], key_pixels[anchor, 1], back, patch
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
        marks[i, 0] = score
        if status[i] == FOUND and score < rules[1]:
            status[i] = UNLIKE
        if status[i] != FOUND:
            continue
        pixels[i, 2], pixels[i, 3] = u * size, v * size
        ideals[i, 0], ideals[i, 1] = view[0], view[1]
        _unbent(lens, u * size, v * size, ideals[i], slopes[i])
        # Interpolating takes noise away pixel by pixel, and spreads it over the neighbours: what
        # the patch as a whole is off stays. The keyframe's is sampled at all sorts of places.
        variance = residual / (SIDE * SIDE - 4.0) / (0.5 * (smoothed + _SMOOTHED)) * size * size
        noises[i, 0], noises[i, 1] = variance * inverse[1, 1], variance * inverse[1, 2]
        noises[i, 2] = variance * inverse[2, 2]
        half_angle, octaves = change_of_view(planes[anchor], transforms[k])
        spread = (
            (rules[4] * size) ** 2 + (2.0 * rules[5] * half_angle) ** 2 + (rules[6] * octaves) ** 2
        )
        share = rules[7] * rules[7]
        misplaced[i, 0] = spread + share * noises[i, 0]
        misplaced[i, 1] = share * noises[i, 1]
        misplaced[i, 2] = spread + share * noises[i, 2]
    return pixels, ideals, slopes, noises, misplaced, marks, status


@compiled
def _unbent(lens: Array, u: float, v: float, ideal: Array, slopes: Array) -> None:
    """Fill the ideal point of a pixel by Newton's method from a point near it, and the slopes."""
    for _ in range(4):
        now_u, now_v, ux, uy, vx, vy = bent(lens, ideal[0], ideal[1])
        slopes[0, 0], slopes[0, 1], slopes[1, 0], slopes[1, 1] = ux, uy, vx, vy
        du, dv = u - now_u, v - now_v
        if du * du + dv * dv < 1e-14:
            return
        det = ux * vy - uy * vx
        ideal[0] += (vy * du - uy * dv) / det
        ideal[1] += (ux * dv - vx * du) / det


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
