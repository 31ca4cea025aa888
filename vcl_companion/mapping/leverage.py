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
from vcl_companion.vision.schur import eliminated

# By fewer landmarks no view is placed.
_LEAST_SEEN = 10


def leverages(views: Views) -> Array:
    """Return (N,) how much of some motion of the free poses each landmark decides, 0 to 1.

    The landmarks' own positions are eliminated; the known distances of the
    views fix the scale. Where all together do not fix the poses, views that see
    hardly any are left out, and who is seen by fewer than two others decides
    nothing; all are 1 where that does not help.

    Args:
        views: an adjusted estimate, every landmark seen at least twice.
    """
    shares = _shares(views)
    if shares is None:
        shares = _of_supported(views)
    return np.ones(len(views.points)) if shares is None else shares


def _of_supported(views: Views) -> Array | None:
    """Return the same without views that see too little to have a place, if there are any."""
    seen = np.isfinite(views.ideal[:, :, 0])
    kept = np.flatnonzero((seen.sum(axis=0) >= _LEAST_SEEN) | (np.arange(seen.shape[1]) == 0))
    rows = np.flatnonzero(seen[:, kept].sum(axis=1) >= 2)
    if len(kept) in (1, seen.shape[1]) or not len(rows):
        return None
    number = {int(view): at for at, view in enumerate(kept)}
    shares = _shares(
        Views(
            bodies=tuple(views.bodies[i] for i in kept),
            mountings=tuple(views.mountings[i] for i in kept),
            slopes=views.slopes[np.ix_(rows, kept)],
            ideal=views.ideal[np.ix_(rows, kept)],
            points=views.points[rows],
            distances=tuple(
                replace(d, a=number[d.a], b=number[d.b])
                for d in views.distances
                if d.a in number and d.b in number
            ),
        )
    )
    if shares is None:
        return None
    out = np.zeros(len(seen))
    out[rows] = shares
    return out


def _shares(views: Views) -> Array | None:
    """Return what ``leverages`` does; None where all together do not fix the poses."""
    n, v = views.ideal.shape[:2]
    try:
        system = normal_equations(views, None)
        inverse = np.asarray(np.linalg.inv(system.point_block), dtype=np.float64)
        total = system.pose_block - eliminated(system.cross, inverse, system.seen)
        covariance = np.zeros_like(total)
        covariance[6:, 6:] = np.linalg.inv(total[6:, 6:])
        np.linalg.cholesky(total[6:, 6:])
    except np.linalg.LinAlgError:
        return None
    by_pose, by_point = np.zeros((n, v, 2, 6)), np.zeros((n, v, 2, 3))
    seen = np.isfinite(views.ideal[:, :, 0])
    for i in range(v):
        j = np.flatnonzero(seen[:, i])
        _, by_pose[j, i], by_point[j, i] = linearized(
            views.bodies[i],
            views.mountings[i],
            views.slopes[j, i],
            views.points[j],
            views.ideal[j, i],
        )
    shares = np.ones(n)
    n_seen = seen.sum(axis=1)
    for s in np.unique(n_seen[n_seen >= 2]):
        # Only the s views that see a landmark enter its own share: small matrices.
        j = np.flatnonzero(n_seen == s)
        at = np.nonzero(seen[j])[1].reshape(-1, s)
        pose = by_pose[j[:, None], at]
        point = by_point[j[:, None], at].reshape(-1, 2 * s, 3)
        blocks = covariance.reshape(v, 6, v, 6)[at[:, :, None], :, at[:, None, :], :]
        spread = np.einsum("naki,nabij,nblj->nakbl", pose, blocks, pose, optimize=True)
        spread = spread.reshape(-1, 2 * s, 2 * s)
        across = np.eye(2 * s) - point @ np.linalg.pinv(point)
        shares[j] = np.linalg.eigvalsh(across @ spread @ across)[:, -1]
    return np.asarray(np.clip(np.nan_to_num(shares, nan=1.0), 0.0, 1.0))
