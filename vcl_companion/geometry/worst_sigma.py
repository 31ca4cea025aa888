"""A covariance in one number."""

from __future__ import annotations

import math

import numpy as np

from vcl_companion.geometry.rotation import Array


def worst_sigma(covariance: Array) -> float:
    """Return the 1 sigma in the direction that is known worst, of a (K, K) covariance."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
