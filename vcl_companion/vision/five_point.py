"""Essential matrices of five matches (eq. 3), compiled.

D. Nister, An efficient solution to the five-point relative pose problem, PAMI
2004: the four-dimensional null space of the epipolar equations, ten cubic
constraints, Gauss-Jordan elimination, one polynomial of degree ten.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

SAMPLE_SIZE = 5
MAX_MODELS = 10

# With E = x X + y Y + z Z + W the unknowns are x y z 1. Nister's order of the cubic monomials
# leaves x^2 z, x^2, y^2 z, y^2, xyz, xy last among the eliminated: rows 4 to 9.
_CUBICS = (
    *("xxx", "yyy", "xxy", "xyy", "xxz", "xx1", "yyz", "yy1", "xyz", "xy1"),
    *("xzz", "xz1", "x11", "yzz", "yz1", "y11", "zzz", "zz1", "z11", "111"),
)
_QUADRATICS = ("xx", "xy", "xz", "x1", "yy", "yz", "y1", "zz", "z1", "11")


def _product_table(left: Sequence[str], names: Sequence[str]) -> NDArray[np.int64]:
    """Return (len(left), 4): the index in ``names`` of each monomial times x, y, z and 1."""
    rank = {variable: k for k, variable in enumerate("xyz1")}
    index = {name: k for k, name in enumerate(names)}
    return np.array(
        [[index["".join(sorted(m + v, key=rank.__getitem__))] for v in "xyz1"] for m in left]
    )


_TO_QUADRATIC = _product_table("xyz1", _QUADRATICS)
_TO_CUBIC = _product_table(_QUADRATICS, _CUBICS)


def five_point(ideal_a: Array, ideal_b: Array) -> Array:
    """Find every essential matrix of five matches.

    Args:
        ideal_a: (5, 2) ideal image coordinates x/z, y/z in camera a.
        ideal_b: (5, 2) the same places in camera b.

    Returns:
        (K, 3, 3) with b^T E a = 0 and unit Frobenius norm, K at most 10; none for
        matches that do not fix it, repeated ones for example.
    """
    sample = np.arange(SAMPLE_SIZE, dtype=np.int64)[None]
    return essentials_of_samples(
        np.array(ideal_a, dtype=np.float64, order="C"),
        np.array(ideal_b, dtype=np.float64, order="C"),
        sample,
    )


@compiled
def essentials_of_samples(a: Array, b: Array, samples: NDArray[np.int64]) -> Array:
    """Return the (K, 3, 3) essential matrices of all (B, 5) samples of the (N, 2) matches."""
    found = np.empty((len(samples) * 10, 3, 3))
    count = 0
    basis = np.empty((4, 9))
    matrix = np.empty((10, 20))
    polynomials = np.empty((3, 3, 5))
    roots = np.empty(10)
    for k in range(len(samples)):
        _null_space(a, b, samples[k], basis)
        _constraints(basis, matrix)
        if not _eliminated(matrix):
            continue
        _hidden_variable(matrix, polynomials)
        n_roots = _real_roots(_determinant(polynomials), roots)
        for r in range(n_roots):
            if _essential(basis, polynomials, roots[r], found[count]):
                count += 1
    return found[:count].copy()


@compiled
def _null_space(a: Array, b: Array, sample: NDArray[np.int64], basis: Array) -> None:
    """Fill the (4, 9) orthonormal E, row by row, that all five matches allow (Householder)."""
    m = np.empty((9, 5))
    for k in range(5):
        x, y = a[sample[k], 0], a[sample[k], 1]
        u, v = b[sample[k], 0], b[sample[k], 1]
        m[0, k], m[1, k], m[2, k] = u * x, u * y, u
        m[3, k], m[4, k], m[5, k] = v * x, v * y, v
        m[6, k], m[7, k], m[8, k] = x, y, 1.0
    scale = np.empty(5)
    for k in range(5):
        norm = 0.0
        for i in range(k, 9):
            norm += m[i, k] * m[i, k]
        head = m[k, k] + np.copysign(np.sqrt(norm), m[k, k])
        # The reflection's vector stays in column k: head, then what is there already.
        length = norm - m[k, k] * m[k, k] + head * head
        scale[k] = 2.0 / length if length > 0.0 else 0.0
        m[k, k] = head
        for j in range(k + 1, 5):
            dot = 0.0
            for i in range(k, 9):
                dot += m[i, k] * m[i, j]
            dot *= scale[k]
            for i in range(k, 9):
                m[i, j] -= dot * m[i, k]
    for j in range(4):
        for i in range(9):
            basis[j, i] = 0.0
        basis[j, 5 + j] = 1.0
        for k in range(4, -1, -1):
            dot = 0.0
            for i in range(k, 9):
                dot += m[i, k] * basis[j, i]
            dot *= scale[k]
            for i in range(k, 9):
                basis[j, i] -= dot * m[i, k]


@compiled
def _constraints(basis: Array, matrix: Array) -> None:
    """Fill (10, 20): det E = 0 and 2 E E^T E - tr(E E^T) E = 0 as cubics in x, y, z."""
    gram = np.zeros((3, 3, 10))
    for i in range(3):
        for j in range(i + 1):
            for c in range(3):
                for p in range(4):
                    for q in range(4):
                        gram[i, j, _TO_QUADRATIC[p, q]] += basis[p, 3 * i + c] * basis[q, 3 * j + c]
            gram[j, i] = gram[i, j]
    half_trace = 0.5 * (gram[0, 0] + gram[1, 1] + gram[2, 2])
    for i in range(3):
        gram[i, i] -= half_trace
    matrix[:] = 0.0
    for i in range(3):
        for j in range(3):
            for c in range(3):
                for q in range(10):
                    for p in range(4):
                        matrix[3 * i + j, _TO_CUBIC[q, p]] += gram[i, c, q] * basis[p, 3 * c + j]
    minor = np.empty(10)
    for j in range(3):
        one, other = (j + 1) % 3, (j + 2) % 3
        minor[:] = 0.0
        for p in range(4):
            for q in range(4):
                minor[_TO_QUADRATIC[p, q]] += (
                    basis[p, one] * basis[q, 3 + other] - basis[p, other] * basis[q, 3 + one]
                )
        for q in range(10):
            for p in range(4):
                matrix[9, _TO_CUBIC[q, p]] += minor[q] * basis[p, 6 + j]


@compiled
def _eliminated(matrix: Array) -> bool:
    """Eliminate the first ten monomials; only rows 4 to 9 are finished. False where singular."""
    for k in range(10):
        pivot = k
        for i in range(k + 1, 10):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if not abs(matrix[pivot, k]) > 1e-14:
            return False
        if pivot != k:
            for j in range(k, 20):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
        inverse = 1.0 / matrix[k, k]
        for j in range(k, 20):
            matrix[k, j] *= inverse
        for i in range(k + 1, 10):
            factor = matrix[i, k]
            for j in range(k, 20):
                matrix[i, j] -= factor * matrix[k, j]
    for k in range(9, 4, -1):
        for i in range(4, k):
            factor = matrix[i, k]
            for j in range(10, 20):
                matrix[i, j] -= factor * matrix[k, j]
    return True


@compiled
def _hidden_variable(matrix: Array, polynomials: Array) -> None:
    """Fill (3, 3, 5): the equations in x, y, 1 whose coefficients are polynomials in z."""
    for k in range(3):
        upper, lower = 4 + 2 * k, 5 + 2 * k
        for v in range(2):
            first = 10 + 3 * v
            polynomials[k, v, 0] = matrix[upper, first + 2]
            polynomials[k, v, 1] = matrix[upper, first + 1] - matrix[lower, first + 2]
            polynomials[k, v, 2] = matrix[upper, first] - matrix[lower, first + 1]
            polynomials[k, v, 3] = -matrix[lower, first]
            polynomials[k, v, 4] = 0.0
        polynomials[k, 2, 0] = matrix[upper, 19]
        for d in range(1, 4):
            polynomials[k, 2, d] = matrix[upper, 19 - d] - matrix[lower, 20 - d]
        polynomials[k, 2, 4] = -matrix[lower, 16]


@compiled
def _determinant(polynomials: Array) -> Array:
    """Return the (11,) determinant of the three equations, lowest power of z first."""
    out = np.zeros(11)
    minor = np.empty(7)
    for k in range(3):
        one, other = (k + 1) % 3, (k + 2) % 3
        minor[:] = 0.0
        for p in range(4):
            for q in range(4):
                minor[p + q] += (
                    polynomials[one, 0, p] * polynomials[other, 1, q]
                    - polynomials[other, 0, p] * polynomials[one, 1, q]
                )
        for p in range(7):
            for q in range(5):
                out[p + q] += minor[p] * polynomials[k, 2, q]
    return out


@compiled
def _essential(basis: Array, polynomials: Array, z: float, out: Array) -> bool:
    """Write E of one root; False where x and y are not fixed by it."""
    rows = np.empty((3, 3))
    for k in range(3):
        for v in range(3):
            value = 0.0
            for d in range(4, -1, -1):
                value = value * z + polynomials[k, v, d]
            rows[k, v] = value
    best, x, y = 0.0, 0.0, 0.0
    for k in range(3):
        one, other = (k + 1) % 3, (k + 2) % 3
        w = rows[one, 0] * rows[other, 1] - rows[one, 1] * rows[other, 0]
        if abs(w) > best:
            best = abs(w)
            x = (rows[one, 1] * rows[other, 2] - rows[one, 2] * rows[other, 1]) / w
            y = (rows[one, 2] * rows[other, 0] - rows[one, 0] * rows[other, 2]) / w
    norm = np.sqrt(x * x + y * y + z * z + 1.0)
    if best == 0.0 or not np.isfinite(norm):
        return False
    for i in range(9):
        entry = x * basis[0, i] + y * basis[1, i] + z * basis[2, i] + basis[3, i]
        out[i // 3, i % 3] = entry / norm
    return True


@compiled
def _real_roots(polynomial: Array, roots: Array) -> int:
    """Fill the real roots of a polynomial, lowest power first; return how many there are.

    Those inside [-1, 1] are its own, those outside the reciprocals of the
    reversed polynomial's: nothing overflows.
    """
    size = np.abs(polynomial).max()
    if not (size > 0.0 and np.isfinite(size)):
        return 0
    inside = np.empty(len(polynomial))
    outside = np.empty(len(polynomial))
    n_inside = _roots_in_unit(polynomial / size, inside)
    n_outside = _roots_in_unit(polynomial[::-1] / size, outside)
    count = 0
    for k in range(n_inside):
        roots[count] = inside[k]
        count += 1
    for k in range(n_outside):
        if 1e-8 < abs(outside[k]) < 1.0 and count < len(roots):
            roots[count] = 1.0 / outside[k]
            count += 1
    return count


@compiled
def _roots_in_unit(polynomial: Array, roots: Array) -> int:
    """Fill the real roots within [-1, 1]: between two extrema there is at most one.

    The extrema are the roots of the derivative, found in the same way, from the
    linear derivative upwards.
    """
    degree = len(polynomial) - 1
    derivatives = np.empty((degree + 1, degree + 1))
    derivatives[0] = polynomial
    for m in range(1, degree):
        for k in range(degree - m + 1):
            derivatives[m, k] = derivatives[m - 1, k + 1] * (k + 1)
    ends = np.empty(degree + 2)
    n_roots = 0
    for m in range(degree - 1, -1, -1):
        top = degree - m
        ends[0] = -1.0
        for k in range(n_roots):
            ends[k + 1] = roots[k]
        ends[n_roots + 1] = 1.0
        n_ends = n_roots + 2
        n_roots = 0
        low = _value(derivatives[m], top, ends[0])
        for k in range(1, n_ends):
            high = _value(derivatives[m], top, ends[k])
            if (low < 0.0 < high) or (high < 0.0 < low) or (low == 0.0 and high != 0.0):
                roots[n_roots] = _bracketed(
                    derivatives[m], top, ends[k - 1], ends[k], low < 0.0 or high > 0.0
                )
                n_roots += 1
            low = high
    return n_roots


@compiled
def _value(polynomial: Array, degree: int, x: float) -> float:
    value = polynomial[degree]
    for k in range(degree - 1, -1, -1):
        value = value * x + polynomial[k]
    return float(value)


@compiled
def _bracketed(polynomial: Array, degree: int, low: float, high: float, rising: bool) -> float:
    """Return the root between ``low`` and ``high``: Newton's steps, halved when they leave."""
    x = 0.5 * (low + high)
    for _ in range(60):
        value, slope = polynomial[degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * x + value
            value = value * x + polynomial[k]
        if value == 0.0:
            return x
        if (value > 0.0) == rising:
            high = x
        else:
            low = x
        new = x - value / slope
        if not low <= new <= high:
            new = 0.5 * (low + high)
        if abs(new - x) < 1e-14:
            return float(new)
        x = new
    return x
