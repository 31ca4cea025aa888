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
from vcl_companion.vision import bundle
from vcl_companion.vision.bundle import Views, pose_information
from vcl_companion.vision.information import covariance_of

# By fewer landmarks no view is placed.
_LEAST_SEEN = 10
_SINGULAR = 1e-10


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
    known = covariance_of(pose_information(views)[6:, 6:], _SINGULAR)
    if known is None:
        return None
    covariance = np.zeros((6 * len(views.bodies),) * 2)
    covariance[6:, 6:] = known
    return np.clip(bundle.leverages(views, covariance), 0.0, 1.0)
