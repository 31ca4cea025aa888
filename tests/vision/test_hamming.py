"""The nearest binary descriptors: exactly those of a small map, nearly always of a large one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from vcl_companion.vision.hamming import FAR, hamming_index, nearest_two

Bytes = NDArray[np.uint8]


def places(rng: np.random.Generator, n: int, n_bytes: int = 61) -> Bytes:
    """Descriptors alike in groups, as those of an image's blobs and corners are."""
    kinds = rng.random((40, 8 * n_bytes)) < 0.5
    bits = kinds[rng.integers(0, 40, n)] ^ (rng.random((n, 8 * n_bytes)) < 0.25)
    return np.packbits(bits, axis=1)


def seen_again(rng: np.random.Generator, descriptors: Bytes, share: float) -> Bytes:
    bits = np.unpackbits(descriptors, axis=1)
    return np.packbits(bits ^ (rng.random(bits.shape) < share), axis=1)


@pytest.mark.parametrize("n_bytes", [61, 32, 64])
def test_a_small_map_is_searched_exactly(n_bytes: int) -> None:
    rng = np.random.default_rng(1)
    entries, queries = places(rng, 300, n_bytes), places(rng, 50, n_bytes)
    owner = np.sort(rng.integers(0, 120, 300))
    landmark, nearest, other = nearest_two(queries, hamming_index(entries, owner))
    different = np.unpackbits(queries[:, None] ^ entries[None], axis=2).sum(axis=2)
    assert np.array_equal(nearest, different.min(axis=1))
    for i in range(50):
        assert different[i, owner == landmark[i]].min() == nearest[i]
        assert different[i, owner != landmark[i]].min() == other[i]


def test_one_landmark_has_no_other() -> None:
    rng = np.random.default_rng(2)
    entries = places(rng, 5)
    landmark, nearest, other = nearest_two(entries, hamming_index(entries, np.full(5, 7)))
    assert landmark.tolist() == [7] * 5
    assert nearest.tolist() == [0] * 5
    assert other.tolist() == [FAR] * 5
    nobody = nearest_two(entries, hamming_index(entries[:0], np.zeros(0, np.int64)))
    assert nobody[0].tolist() == [-1] * 5


def test_a_large_map_is_divided_and_hardly_anything_missed() -> None:
    rng = np.random.default_rng(3)
    entries = places(rng, 20_000)
    owner = np.arange(20_000) // 2
    index = hamming_index(entries, owner)
    assert len(index.pivots) > 100
    assert index.first[-1] == len(index.words) == 20_000
    chosen = rng.integers(0, 20_000, 400)
    landmark, nearest, other = nearest_two(seen_again(rng, entries[chosen], 0.1), index)
    found = landmark == owner[chosen]
    assert found.mean() > 0.9
    assert 30 < np.median(nearest[found]) < 65
    assert (other > nearest).all()
    whole = nearest_two(entries[:10], hamming_index(entries, owner, divided=False))
    assert whole[0].tolist() == owner[:10].tolist()
