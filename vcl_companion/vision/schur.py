"""What landmarks are off by with the views that see them, in compiled code.

A landmark hangs on the few views that see it, not on all: the cost is linear in
keyframes. One thread: on a busy computer BLAS waits for its own threads longer
than it computes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import reordered
from vcl_companion.geometry.rotation import Array


@reordered
def carried(lever: NDArray[np.float32], covariance: Array, landmarks: NDArray[np.int64]) -> Array:
    """Return (M, 3, 3), for each landmark lever @ covariance @ lever transposed.

    Args:
        lever: (N, 3, 6V) landmark error per view error, zero for views that do not see it.
        covariance: (6V, 6V) of the views, symmetric.
        landmarks: (M,) rows of ``lever``.
    """
    v = lever.shape[2] // 6
    out = np.zeros((len(landmarks), 3, 3))
    views = np.empty(v, dtype=np.int64)
    left, part = np.empty((3, 6)), np.empty((3, 3))
    for m in range(len(landmarks)):
        of_one = lever[landmarks[m]]
        s = 0
        for i in range(v):
            some = np.float32(0.0)
            for r in range(3):
                for c in range(6):
                    some += abs(of_one[r, 6 * i + c])
            if some != 0.0:
                views[s] = i
                s += 1
        for p in range(s):
            a = 6 * views[p]
            # Half of this view's own, and all of those before: with the transpose it is whole.
            left[:] = 0.0
            for q in range(p + 1):
                b = 6 * views[q]
                share = 0.5 if q == p else 1.0
                for r in range(3):
                    for d in range(6):
                        by = share * of_one[r, b + d]
                        for c in range(6):
                            left[r, c] += by * covariance[b + d, a + c]
            for r in range(3):
                for c in range(3):
                    total = 0.0
                    for d in range(6):
                        total += left[r, d] * of_one[c, a + d]
                    part[r, c] = total
            for r in range(3):
                for c in range(3):
                    out[m, r, c] += part[r, c] + part[c, r]
    return out
