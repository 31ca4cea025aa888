"""An adjustment in which every landmark counts by how well its patch is found again (IV-C).

A patch at the edge of what stands out from a wall shows two depths: where it is found depends on
from how far away it is seen. Such landmarks are half of those of a facade, and err to one side:
what stands out is sills and cornices, above the drone more than below. Their grey levels do not
fit when they are found, and by that they are known; and each counts less in the direction in
which its patch has less texture.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle import BundleOptions, Views, adjust

# No patch is found better than this, whatever its grey levels say.
_LEAST_NOISE_PX = 0.08
# Of a patch that counts as one pixel does in an adjustment without weights; so do those of which
# nothing is known.
_USUAL_NOISE_PX = 0.1


def adjust_weighed(views: Views, noise: Array, options: BundleOptions) -> tuple[Views, float]:
    """Adjust by patches, see ``vision.bundle.adjust``.

    Args:
        views: the first estimate.
        noise: (N, 3) xx xy yy of each landmark's pixels by the grey levels, px^2; NaN: not known.
        options: of the adjustment; its robust scale is for a patch of usual noise.

    Returns:
        The adjusted views, and the robust noise of one pixel coordinate, px, without weights.
    """
    return adjust(views, options, _weights(noise))


def _weights(noise: Array) -> Array:
    """Return (N, 2, 2) that turn residuals in px into such of patches of usual noise."""
    known = np.isfinite(noise).all(axis=1)
    covariance = np.tile((_USUAL_NOISE_PX**2 - _LEAST_NOISE_PX**2) * np.eye(2), (len(noise), 1, 1))
    covariance[known] = noise[known][:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    covariance += _LEAST_NOISE_PX**2 * np.eye(2)
    return np.asarray(_USUAL_NOISE_PX * np.linalg.inv(np.linalg.cholesky(covariance)))
