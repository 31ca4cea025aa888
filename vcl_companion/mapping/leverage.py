"""Which landmarks decide the keyframes' poses all by themselves (IV-C).

A wrong match that happens to satisfy the epipolar geometry is triangulated
close to the cameras, where parallax is large: it then outweighs hundreds of
right ones, pulls the poses until its own residual is small, and no residual
test finds it. A map has to stand without such landmarks.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle import Views, linearized, normal_equations


def leverages(views: Views) -> Array:
    """Return (N,) how much of some motion of the free poses each landmark decides, 0 to 1.

    The landmarks' own positions are eliminated; the known distances of the
    views fix the scale. All are 1 when all together do not fix the poses.

    Args:
        views: an adjusted estimate, every landmark seen at least twice.
    """
    n, v = views.ideal.shape[:2]
    own = np.zeros((n, 6 * v, 6 * v))
    for i in range(v):
        seen = np.flatnonzero(np.isfinite(views.ideal[:, i, 0]))
        _, j_pose, _ = linearized(
            views.bodies[i],
            views.mountings[i],
            views.slopes[seen, i],
            views.points[seen],
            views.ideal[seen, i],
        )
        block = slice(6 * i, 6 * i + 6)
        own[seen, block, block] = np.einsum("nki,nkj->nij", j_pose, j_pose)
    # Without landmarks only the distances are left.
    no_points = replace(views, points=views.points[:0], ideal=views.ideal[:0])
    by_distances = normal_equations(no_points, None).pose_block
    try:
        system = normal_equations(views, None)
        inverse = np.linalg.inv(system.point_block)
        own -= system.cross @ inverse @ np.swapaxes(system.cross, 1, 2)
        free = slice(6, None)
        total = (own.sum(axis=0) + by_distances)[free, free]
        whiten = np.linalg.inv(np.linalg.cholesky(total))
        shares = np.linalg.eigvalsh(whiten @ own[:, free, free] @ whiten.T)[:, -1]
    except np.linalg.LinAlgError:
        return np.ones(n)
    return np.asarray(np.clip(np.nan_to_num(shares, nan=1.0), 0.0, 1.0))
