"""Which axes of an attitude are swapped or of the wrong sign, by turns that the camera has seen.

No mounting of the camera explains these; one of them does, undone:

* the gyroscopes' axes: each turn comes mirrored;
* components of the quaternion, of which an odd number is swapped or turned round: an even number is
  another, right-handed body, and as good as another mounting;
* the angles roll, pitch and yaw, in any way.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import (
    Array,
    euler_from_matrix,
    log_so3,
    matrix_from_euler,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

_ANGLES = ("roll", "pitch", "yaw")
_COMPONENTS = ("x", "y", "z")
# What is left of turns, as a share of them, when what is swapped is undone; and of what was before.
_EXPLAINS, _LESS = 0.25, 0.5


@dataclass(frozen=True, eq=False)
class Windows:
    """Turns, each seen and said.

    Attributes:
        seen: (N, 3) rotation vectors of start_from_end in camera axes, rad.
        starts: (N, 3, 3) ned_from_body at each one's start.
        ends: (N, 3, 3) the same at its end.
    """

    seen: Array
    starts: Array
    ends: Array

    @property
    def said(self) -> Array:
        """(N, 3) rotation vectors of start_from_end in body axes, rad."""
        return _turns(self.starts, self.ends)


def swapped_axes(windows: Windows, body_from_cam: Array, misfit: float) -> str | None:
    """Say what is swapped in an attitude; None where nothing is, or another thing is wrong.

    Args:
        windows: turns about three axes.
        body_from_cam: (3, 3) how the camera sits.
        misfit: what the best mounting leaves of them, as a share.
    """
    true = windows.seen @ body_from_cam.T
    left, what = min(_explained(windows, true), key=lambda one: one[0])
    return what if left < min(_EXPLAINS, _LESS * misfit) else None


def _explained(windows: Windows, true: Array) -> Iterator[tuple[float, str]]:
    """Yield what each mistake, undone, leaves of the turns, and its name."""
    said = windows.said
    quaternions = [_each(quaternion_from_matrix, r) for r in (windows.starts, windows.ends)]
    angles = [_each(euler_from_matrix, r) for r in (windows.starts, windows.ends)]
    for swap in _signed_permutations():
        if np.linalg.det(swap) < 0.0:
            yield _left(said @ swap, true), _text(swap, _ANGLES, "")
            starts, ends = (
                _each(matrix_from_quaternion, np.column_stack([q[:, :1], q[:, 1:] @ swap]))
                for q in quaternions
            )
            name = _text(swap, _COMPONENTS, " of the quaternion")
            yield _left(_turns(starts, ends), true), name
        if not np.array_equal(swap, np.eye(3)):
            starts, ends = (
                np.array([matrix_from_euler(*row) for row in (a @ swap).tolist()]) for a in angles
            )
            yield _left(_turns(starts, ends), true), _text(swap, _ANGLES, " of the angles")


def _signed_permutations() -> Iterator[Array]:
    """Yield the 48 (3, 3) matrices that take axes to axes: what is said from what is true."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            yield np.eye(3)[list(order)] * np.array(signs)


def _each(convert: Callable[[Array], Array | tuple[float, float, float]], values: Array) -> Array:
    return np.array([convert(value) for value in values])


def _turns(starts: Array, ends: Array) -> Array:
    return np.array([log_so3(s.T @ e) for s, e in zip(starts, ends, strict=True)]).reshape(-1, 3)


def _left(turns: Array, true: Array) -> float:
    """Return the median of what two (N, 3) differ by, as a share of the larger."""
    sizes = np.maximum(np.linalg.norm(turns, axis=1), np.linalg.norm(true, axis=1))
    return float(np.median(np.linalg.norm(turns - true, axis=1) / np.maximum(sizes, 1e-9)))


def _text(swap: Array, names: tuple[str, ...], of: str) -> str:
    """Say what comes as what, of a matrix that takes what is true to what is said."""
    parts = []
    for k, name in enumerate(names):
        row = int(np.argmax(np.abs(swap[:, k])))
        if swap[row, k] < 0.0 or row != k:
            parts.append(f"{name} comes as {'minus ' if swap[row, k] < 0.0 else ''}{names[row]}")
    return ", ".join(parts) + of
