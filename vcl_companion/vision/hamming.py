"""The nearest binary descriptors of a map, fast however large the map is (IV-A, issue 4).

A small map is searched whole. A large one is divided among pivots, descriptors
of its own: a query looks only at what is nearest to those pivots that are
nearest to itself (an inverted file, as of Sivic and Zisserman, ICCV 2003, with
the descriptors kept). What that misses now and then, another feature makes up for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled

Ints = NDArray[np.int64]
Words = NDArray[np.uint64]

FAR = 1 << 30
"""Distance to what is not there."""

# Enough for AKAZE's 61 bytes; as many for all, so that the loops over them vanish.
_WORD_BYTES, _N_WORDS = 8, 8
# Up to so many descriptors are searched one by one.
_SEARCHED_WHOLE = 6000
_PER_PIVOT = 96
# Of a divided map a query looks at so many descriptors.
_LOOKED_AT = 2400


@dataclass(frozen=True, eq=False)
class HammingIndex:
    """Binary descriptors in the order in which they are searched.

    Attributes:
        words: (M, 8) the descriptors, those of one pivot together.
        owner: (M,) landmark of each.
        pivots: (P, 8); none when everything is searched.
        first: (P + 1,) where each pivot's descriptors begin.
    """

    words: Words
    owner: Ints
    pivots: Words
    first: Ints


def hamming_index(
    descriptors: NDArray[np.uint8], owner: NDArray[np.integer], divided: bool = True
) -> HammingIndex:
    """Lay out binary descriptors for search.

    Args:
        descriptors: (M, D) bytes.
        owner: (M,) landmark that each belongs to.
        divided: whether many of them are divided among pivots; takes a while, once.
    """
    words, owners = _words(descriptors), np.asarray(owner, dtype=np.int64)
    whole = np.array([0, len(words)], dtype=np.int64)
    if not divided or len(words) <= _SEARCHED_WHOLE:
        return HammingIndex(words, owners, words[:0], whole)
    n_pivots = len(words) // _PER_PIVOT
    pivots = words[np.linspace(0, len(words) - 1, n_pivots).astype(np.intp)]
    every = np.arange(n_pivots)
    all_pivots = np.array([0, n_pivots], dtype=np.int64)
    place = _nearest_two(words, pivots, every, pivots[:0], all_pivots, 0)[0]
    order = np.argsort(place, kind="stable")
    first = np.searchsorted(place[order], np.arange(n_pivots + 1)).astype(np.int64)
    return HammingIndex(words[order], owners[order], pivots, first)


def nearest_two(queries: NDArray[np.uint8], index: HammingIndex) -> tuple[Ints, Ints, Ints]:
    """Find the nearest descriptor of each query, and the nearest of another landmark.

    Args:
        queries: (N, D) bytes, as many as the indexed ones have.
        index: of the map.

    Returns:
        (N,) landmark of the nearest, -1 for none; (N,) its distance, bits; (N,) distance
        of the nearest of any other landmark; ``FAR`` where there is none.
    """
    return _nearest_two(
        _words(queries), index.words, index.owner, index.pivots, index.first, _LOOKED_AT
    )


def _words(descriptors: NDArray[np.uint8]) -> Words:
    """Return (N, 8) descriptors in words, filled up with zeros."""
    n, n_bytes = descriptors.shape
    padded = np.zeros((n, _WORD_BYTES * _N_WORDS), dtype=np.uint8)
    padded[:, :n_bytes] = descriptors
    return padded.view(np.uint64)


@compiled
def _nearest_two(
    queries: Words, words: Words, owner: Ints, pivots: Words, first: Ints, looked_at: int
) -> tuple[Ints, Ints, Ints]:
    """Search all, or as many as are wanted of the nearest pivots' (see the module)."""
    n, n_pivots = len(queries), len(pivots)
    nearest = np.full(n, -1, dtype=np.int64)
    best, other = np.full(n, FAR), np.full(n, FAR)
    n_distances = 64 * _N_WORDS + 1
    away = np.empty(n_pivots, dtype=np.int64)
    turn = np.empty(max(n_pivots, 1), dtype=np.int64)
    turn[0] = 0
    begins = np.empty(n_distances + 1, dtype=np.int64)
    for i in range(n):
        # The pivots in the order of their distance: whole numbers, so by counting.
        begins[:] = 0
        for p in range(n_pivots):
            away[p] = _apart(queries, i, pivots, p, 0) + _apart(queries, i, pivots, p, 4)
            begins[away[p] + 1] += 1
        for d in range(n_distances):
            begins[d + 1] += begins[d]
        for p in range(n_pivots):
            turn[begins[away[p]]] = p
            begins[away[p]] += 1
        n_seen = 0
        landmark, least, second = np.int64(-1), np.int64(FAR), np.int64(FAR)
        for k in range(max(n_pivots, 1)):
            if n_pivots > 0 and n_seen >= looked_at:
                break
            begin, end = first[turn[k]], first[turn[k] + 1]
            n_seen += end - begin
            # From zero on: numba looks out for negative positions otherwise.
            cell, owners = words[begin:end], owner[begin:end]
            for j in range(end - begin):
                distance = _apart(queries, i, cell, j, 0)
                if distance >= second:
                    continue
                distance += _apart(queries, i, cell, j, 4)
                if distance >= second:
                    continue
                if owners[j] == landmark:
                    if distance < least:
                        least = distance
                elif distance < least:
                    second, landmark, least = least, owners[j], distance
                else:
                    second = distance
        nearest[i], best[i], other[i] = landmark, least, second
    return nearest, best, other


@compiled
def _apart(a: Words, i: int, b: Words, j: int, begin: int) -> np.int64:
    """Count the bits that differ in four words of two rows."""
    return (
        _ones(a[i, begin] ^ b[j, begin])
        + _ones(a[i, begin + 1] ^ b[j, begin + 1])
        + _ones(a[i, begin + 2] ^ b[j, begin + 2])
        + _ones(a[i, begin + 3] ^ b[j, begin + 3])
    )


@compiled
def _ones(x: np.uint64) -> np.int64:
    """Count the bits set; the compiler knows this form and has one instruction for it."""
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))
