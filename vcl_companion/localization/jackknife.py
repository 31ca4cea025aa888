"""How far a pose goes when a third of what it rests on is left out: uncertainty by the data itself.

A covariance by slopes takes the errors of matches for independent, and knows only the one minimum
that it stands in. Where much is far away and little near, a step up and a nod down look alike:
then a group of wrong matches (a shadow that moved, a row of windows) draws the pose along that
valley, and a thousand matches seem to hold it there. Left out in turn, thirds of the image
tell (delete-d jackknife: J. Shao, C. F. J. Wu, A general theory for jackknife variance estimation,
Annals of Statistics 17, 1989).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array

_N_STRIPS = 3

Mask = NDArray[np.bool_]


def jackknife(
    pose: Pose, places: Array, used: Mask, without: Callable[[Mask], Pose | None]
) -> Array:
    """Return the (6, 6) local covariance of a pose, by what it is without parts of an image.

    Args:
        pose: by all.
        places: (M, 2) where in the image the matches lie, in any unit.
        used: (M,) which of them the pose rests on: as many of these are in each part.
        without: finds the pose by the matches that are kept; None where that cannot be.
    """
    total, n = np.zeros((6, 6)), 0
    for axis in (0, 1):
        bounds = np.quantile(places[used, axis], np.arange(1, _N_STRIPS) / _N_STRIPS)
        strip = np.searchsorted(bounds, places[:, axis])
        for k in range(_N_STRIPS):
            other = without(np.asarray(strip != k))
            if other is not None:
                off = pose.local(other)
                total += np.outer(off, off)
                n += 1
    return (_N_STRIPS - 1) * total / max(n, 1)


def no_less_than(covariance: Array, other: Array) -> Array:
    """Return a positive definite (K, K) covariance, widened where another one is wider."""
    root = np.linalg.cholesky(covariance)
    half = np.linalg.solve(root, other)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, half.T))
    widened = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return np.asarray(root @ widened @ root.T)
