"""From a normal matrix to a covariance, or to the statement that there is none (eq. 12).

And from errors to their noise.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array

_ROUNDING = 1e-9


def covariance_of(information: Array, least_eigenvalue: float) -> Array | None:
    """Invert normal matrices that fix what they are about.

    Args:
        information: (..., K, K) symmetric.
        least_eigenvalue: of the matrix scaled to a diagonal of ones, so that units
            do not count; what is below is rounding, not information.

    Returns:
        (..., K, K) inverses, symmetric; None when one of the matrices has a
        smaller eigenvalue or is not finite.
    """
    with np.errstate(all="ignore"):  # whatever the numbers are, they only fail the test
        size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
        scale = size[..., :, None] * size[..., None, :]
        unit = information / scale
        if not np.all(np.isfinite(unit)) or np.any(np.linalg.eigvalsh(unit) < least_eigenvalue):
            return None
        out = np.linalg.inv(unit) / scale
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def robust_sigma(errors: Array) -> float:
    """Return the 1 sigma of normal errors about 0, (N,), of which less than half may be wrong."""
    return 1.4826 * float(np.median(np.abs(errors)))


def squared_distances(apart: Array, covariance: Array) -> Array:
    """Return (N,) squared Mahalanobis distances.

    Args:
        apart: (N, K) differences.
        covariance: (N, K, K) of each, positive definite.

    Raises:
        numpy.linalg.LinAlgError: one of them is singular.
    """
    solved = np.linalg.solve(covariance, apart[..., None])[..., 0]
    return np.asarray(np.einsum("nk,nk->n", apart, solved))


def is_covariance(matrix: Array) -> bool:
    """Whether a (K, K) matrix is finite, symmetric and has no negative eigenvalue."""
    if not (np.all(np.isfinite(matrix)) and np.array_equal(matrix, matrix.T)):
        return False
    sigma = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    sigma = np.where(sigma > 0.0, sigma, 1.0)
    with np.errstate(all="ignore"):
        unit = matrix / sigma[:, None] / sigma
    return bool(np.all(np.isfinite(unit)) and np.linalg.eigvalsh(unit)[0] >= -_ROUNDING)
