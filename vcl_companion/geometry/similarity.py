"""Similarities, named ``a_from_b`` like poses: between two frames of which each has a scale.

The covariance of one is 7x7, order rotation vector (local, rad), translation (in ``a``, m),
natural logarithm of the scale (``Similarity.moved``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3, orthonormalized

# Points whose second extent is so small a share of the first lie in a line.
_FLAT = 1e-9


@dataclass(frozen=True, eq=False)
class Similarity:
    """The transform that takes coordinates in frame ``b`` to frame ``a``: x -> s R x + t.

    Attributes:
        rotation: (3, 3) rotation matrix, a_from_b.
        translation: (3,) origin of ``b`` expressed in ``a``, m.
        scale: how long in ``a`` is what is 1 long in ``b``.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"Similarity.{name} must be finite with shape {shape}: {value}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if not (np.isfinite(self.scale) and self.scale > 0.0):
            raise ValueError(f"Similarity.scale must be positive: {self.scale}")

    @classmethod
    def identity(cls) -> Similarity:
        """Return the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def of_points(cls, b: Array, a: Array, weights: Array | None = None) -> Similarity | None:
        """Return a_from_b that takes points nearest to others (Umeyama 1991).

        Args:
            b: (N, 3) points in frame ``b``.
            a: (N, 3) the same ones in frame ``a``.
            weights: (N,) of each pair's squared distance; None weighs all alike.

        Returns:
            The least-squares similarity; None where the points lie in a line.
        """
        share = np.full(len(b), 1.0) if weights is None else np.asarray(weights)
        share = (share / share.sum())[:, None]
        centre_b, centre_a = (share * b).sum(axis=0), (share * a).sum(axis=0)
        from_b, from_a = b - centre_b, a - centre_a
        u, sizes, vt = np.linalg.svd((share * from_a).T @ from_b)
        if not sizes[1] > _FLAT * max(float(sizes[0]), 1e-12):
            return None
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = orthonormalized((u * sign) @ vt)
        scale = float((sizes * sign).sum() / (share * from_b**2).sum())
        if not scale > 0.0:
            return None
        return cls(rotation, centre_a - scale * rotation @ centre_b, scale)

    def __matmul__(self, other: Similarity) -> Similarity:
        return Similarity(
            self.rotation @ other.rotation, self.apply(other.translation), self.scale * other.scale
        )

    def inverse(self) -> Similarity:
        """Return b_from_a."""
        back = self.rotation.T
        return Similarity(back, -back @ self.translation / self.scale, 1.0 / self.scale)

    def apply(self, points: Array) -> Array:
        """Return (..., 3) points of frame ``b`` in frame ``a``."""
        return np.asarray(self.scale * points @ self.rotation.T + self.translation)

    def of_pose(self, b_from_c: Pose) -> Pose:
        """Return a_from_c: what stands there in ``b``, as it stands in ``a``."""
        return Pose(self.rotation @ b_from_c.rotation, self.apply(b_from_c.translation))

    def moved(self, delta: Array) -> Similarity:
        """Return it perturbed by (7,): rotation vector, translation, logarithm of the scale."""
        return Similarity(
            self.rotation @ exp_so3(delta[:3]),
            self.translation + delta[3:6],
            self.scale * float(np.exp(delta[6])),
        )

    def difference(self, other: Similarity) -> Array:
        """Return the (7,) perturbation that takes this one to ``other`` (see ``moved``)."""
        return np.concatenate(
            [
                log_so3(self.rotation.T @ other.rotation),
                other.translation - self.translation,
                [np.log(other.scale / self.scale)],
            ]
        )
