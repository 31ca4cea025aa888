"""Compiled loops of patch tracking: what landmarks look like from a frame, which to take (IV-D).

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
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

Ints = NDArray[np.int64]

N_LENS = 10
# Of a view: what ``seen_from`` fills, then ``change_of_view``.
N_VIEW = 17


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
    nearness = 1.0 / q2
    ideal_x, ideal_y = q0 * nearness, q1 * nearness
    if not ideal_x * ideal_x + ideal_y * ideal_y < reach:
        return False
    u, v, ux, uy, vx, vy = bent(lens, ideal_x, ideal_y)
    # d(ideal in the frame) / d(ideal in the keyframe)
    q0x, q0y = transform[0, 0] + transform[0, 3] * b, transform[0, 1] + transform[0, 3] * c
    q1x, q1y = transform[1, 0] + transform[1, 3] * b, transform[1, 1] + transform[1, 3] * c
    q2x, q2y = transform[2, 0] + transform[2, 3] * b, transform[2, 1] + transform[2, 3] * c
    hxx, hxy = (q0x - ideal_x * q2x) * nearness, (q0y - ideal_x * q2y) * nearness
    hyx, hyy = (q1x - ideal_y * q2x) * nearness, (q1y - ideal_y * q2y) * nearness
    ixx, ixy, iyx, iyy = plane[5], plane[6], plane[7], plane[8]
    mxx, mxy = ux * hxx + uy * hyx, ux * hxy + uy * hyy
    myx, myy = vx * hxx + vy * hyx, vx * hxy + vy * hyy
    out[0], out[1], out[2], out[3], out[4] = ideal_x, ideal_y, r * nearness, u, v
    out[5], out[6], out[7], out[8] = ux, uy, vx, vy
    out[9], out[10] = mxx * ixx + mxy * iyx, mxx * ixy + mxy * iyy
    out[11], out[12] = myx * ixx + myy * iyx, myx * ixy + myy * iyy
    # The last row of the inverse homography, as one over its value at the point.
    gx, gy, g1 = q1x * q2y - q2x * q1y, q2x * q0y - q0x * q2y, q0x * q1y - q1x * q0y
    weight = (gx * ideal_x + gy * ideal_y + g1) * (ux * vy - uy * vx)
    if not abs(weight) > 1e-12:
        return False
    share = 1.0 / weight
    out[13], out[14] = (vy * gx - vx * gy) * share, (ux * gy - uy * gx) * share
    # A patch seen from behind, or edge on, says nothing.
    return bool(out[9] * out[12] - out[10] * out[11] > 1e-3)


@compiled
def _is_in_view(plane: Array, reach: float, transform: Array) -> bool:
    """Whether a point is before the camera, and not clearly farther out than the lens shows."""
    x, y, r = plane[0], plane[1], plane[2]
    q0 = transform[0, 0] * x + transform[0, 1] * y + transform[0, 2] + transform[0, 3] * r
    q1 = transform[1, 0] * x + transform[1, 1] * y + transform[1, 2] + transform[1, 3] * r
    q2 = transform[2, 0] * x + transform[2, 1] * y + transform[2, 2] + transform[2, 3] * r
    return bool(q2 > 0.0 and q0 * q0 + q1 * q1 < 1.01 * reach * q2 * q2)


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
def viewed(
    chosen: Ints, keyframe: Ints, planes: Array, lens: Array, reach: float, transforms: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return what anchors look like from a frame.

    Args:
        chosen: (M,) anchors.
        keyframe: (A,) of each anchor.
        planes: see the module.
        lens: of the frame.
        reach: of that lens.
        transforms: to the frame, see the module.

    Returns:
        (M, N_VIEW) as ``seen_from`` fills them, then how the line of sight changes
        (``change_of_view``); (M,) which can be seen: the rows of the others say nothing.
    """
    m = len(chosen)
    views, seen = np.zeros((m, N_VIEW)), np.zeros(m, np.bool_)
    for i in range(m):
        plane, transform = planes[chosen[i]], transforms[keyframe[chosen[i]]]
        seen[i] = seen_from(plane, lens, reach, transform, views[i])
        if seen[i]:
            views[i, 15], views[i, 16] = change_of_view(plane, transform)
    return views, seen


@compiled
def unbent(lens: Array, pixels: Array, near: Array) -> tuple[Array, Array]:
    """Find the ideal points of pixels by Newton's method from points near them.

    Args:
        lens: see the module.
        pixels: (M, 2) raw px; where the first is not a number nothing is looked for.
        near: (M, N) whose first two columns are ideal points near them.

    Returns:
        (M, 2) ideal points and (M, 2, 2) the lens's slopes d(pixel) / d(ideal) there; zero where
        nothing was looked for.
    """
    m = len(pixels)
    ideals, slopes = np.zeros((m, 2)), np.zeros((m, 2, 2))
    for i in range(m):
        if math.isnan(pixels[i, 0]):
            continue
        x, y = near[i, 0], near[i, 1]
        for _ in range(4):
            now_u, now_v, ux, uy, vx, vy = bent(lens, x, y)
            slopes[i, 0, 0], slopes[i, 0, 1], slopes[i, 1, 0], slopes[i, 1, 1] = ux, uy, vx, vy
            du, dv = pixels[i, 0] - now_u, pixels[i, 1] - now_v
            if du * du + dv * dv < 1e-14:
                break
            det = ux * vy - uy * vx
            x += (vy * du - uy * dv) / det
            y += (ux * dv - vx * du) / det
        ideals[i, 0], ideals[i, 1] = x, y
    return ideals, slopes


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
    centres = _seen_from_keys(transforms)
    count = 0
    for j in range(n):
        # All anchors of a landmark are of the same point: most of a map is not in view.
        a = first[j]
        if a == first[j + 1] or not _is_in_view(planes[a], reach, transforms[keyframe[a]]):
            continue
        best, least = _most_alike(first[j], first[j + 1], planes, keyframe, centres, rules)
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
    turns = _in_turns(order, rank, size)
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
def _seen_from_keys(transforms: Array) -> Array:
    """Return (V, 4) the frame's camera in each keyframe's axes, turned to face it; and squared."""
    out = np.zeros((len(transforms), 4))
    for v in range(len(transforms)):
        for c in range(3):
            for r in range(3):
                out[v, c] += transforms[v, r, c] * transforms[v, r, 3]
            out[v, 3] += transforms[v, c, 3] ** 2
    return out


@compiled
def _most_alike(
    begin: int, end: int, planes: Array, keyframe: Ints, centres: Array, rules: Array
) -> tuple[int, float]:
    """Return which of a landmark's anchors looks most like it from the frame, -1 for none.

    And the square of how far its patch may be misplaced by the change of view
    (``change_of_view``), px^2. A map has ten and more of them for each landmark: what is
    worse by the angle alone is not looked at further.
    """
    best, least = -1, np.inf
    by_angle, by_octave = (2.0 * rules[3]) ** 2, rules[4] ** 2
    nearest, farthest = 4.0 ** rules[5], 4.0 ** -rules[6]
    for a in range(begin, end):
        x, y, r, v = planes[a, 0], planes[a, 1], planes[a, 2], keyframe[a]
        then2 = x * x + y * y + 1.0
        along = r * (x * centres[v, 0] + y * centres[v, 1] + centres[v, 2])
        now2 = then2 + 2.0 * along + r * r * centres[v, 3]
        ratio = then2 / now2
        sine2 = max(0.5 - 0.5 * (then2 + along) / math.sqrt(then2 * now2), 0.0)
        if not (by_angle * sine2 < least and sine2 <= 0.49 and farthest <= ratio <= nearest):
            continue
        change2 = by_angle * sine2 + by_octave * (0.5 * math.log2(ratio)) ** 2
        if change2 < least:
            best, least = a, change2
    return best, least


@compiled
def _in_turns(order: Ints, rank: Ints, wanted: int) -> Ints:
    """Return the first so many of an order by rank, and in the order among those of one rank."""
    n_of_rank = np.zeros(len(rank) + 1, np.int64)
    for i in order:
        n_of_rank[rank[i] + 1] += 1
    place = np.cumsum(n_of_rank)
    out = np.empty(wanted, np.int64)
    for i in order:
        if place[rank[i]] < wanted:
            out[place[rank[i]]] = i
        place[rank[i]] += 1
    return out


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
