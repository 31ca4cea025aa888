"""How one body's axes lie to another's that turns with it, by how each says that both turned.

Rotation vectors of the same turns, ``a`` in one's axes and ``b`` in the other's, are related by
``b = b_from_a @ a``: Wahba's problem, solved by a singular value decomposition (Kabsch).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import Array, orthonormalized

# Turns that contradict the others weigh less: Cauchy's weights, so many times the median.
_ROUNDS, _SCALE = 8, 2.0


@dataclass(frozen=True, eq=False)
class AxesFit:
    """Axes that turn together.

    Attributes:
        rotation: (3, 3) b_from_a.
        misfit: what is left of the turns as a share of them, 0..2; the median.
    """

    rotation: Array
    misfit: float


def fit_axes(turns_a: Array, turns_b: Array) -> AxesFit:
    """Return the axes under which turns agree best.

    Args:
        turns_a: (N, 3) rotation vectors, rad.
        turns_b: (N, 3) of the same turns.
    """
    sizes = np.maximum(np.linalg.norm(turns_b, axis=1), np.linalg.norm(turns_a, axis=1))
    sizes = np.maximum(sizes, 1e-9)
    weights = np.ones(len(sizes))
    for _ in range(_ROUNDS):
        rotation = orthonormalized((weights[:, None] * turns_b).T @ turns_a)
        left = np.linalg.norm(turns_b - turns_a @ rotation.T, axis=1) / sizes
        misfit = float(np.median(left))
        weights = 1.0 / (1.0 + (left / max(_SCALE * misfit, 1e-6)) ** 2)
    return AxesFit(rotation, misfit)


def turned_about(turns: Array) -> Array:
    """Return (3,) how far (N, 3) turns went in all about three perpendicular axes, rad, falling.

    The axes are those about which they turned most, next most and least.
    """
    _, _, axes = np.linalg.svd(turns, full_matrices=False)
    return np.asarray(np.sort(np.abs(turns @ axes.T).sum(axis=0))[::-1])
