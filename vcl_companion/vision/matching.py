"""Which feature is which: brute force with ratio test, and guided by a prediction (IV-A, IV-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Features
from vcl_companion.vision.hamming import FAR, HammingIndex, hamming_index, nearest_two

Index = NDArray[np.intp]

# Features compared with a whole map at a time: a few megabytes of distances.
_AT_ONCE = 128


@dataclass(frozen=True)
class MatchOptions:
    """When two descriptors are the same place.

    Attributes:
        ratio: best distance over second best must be below (Lowe's test), whole-image search.
        guided_ratio: the same among the candidates near a predicted position.
    """

    ratio: float = 0.85
    guided_ratio: float = 0.9

    def __post_init__(self) -> None:
        if not 0 < self.ratio <= 1 or not 0 < self.guided_ratio <= 1:
            raise ValueError("match ratios must lie in (0, 1]")


def match_mutual(a: Features, b: Features, options: MatchOptions) -> tuple[Index, Index]:
    """Match two images: each other's best, and clearly better than the next.

    Returns:
        (M,) indices into ``a`` and (M,) into ``b``.
    """
    if len(a) < 2 or len(b) < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    best, distance, second = _nearest_of(a, b)
    clear = np.flatnonzero(distance < options.ratio * second)
    if len(clear) == 0:
        return clear, clear
    chosen, which = np.unique(best[clear], return_inverse=True)
    backward, _, _ = _nearest_of(b.subset(chosen), a)
    mutual = backward[which] == clear
    return clear[mutual], best[clear[mutual]]


def match_to_entries(
    features: Features,
    entries: Features,
    owner: Index,
    options: MatchOptions,
    index: HammingIndex | None = None,
) -> tuple[Index, Index]:
    """Match an image against a map whose landmarks have one or more descriptors each.

    Args:
        features: of the image, N of them.
        entries: M descriptors of the map.
        owner: (M,) landmark that each entry belongs to.
        options: the ratio is taken against the best entry of *another* landmark.
        index: the same entries, laid out once, when they are binary; None: laid out here.

    Returns:
        (K,) features and (K,) landmarks, one to one: of several features that
        chose one landmark the closest stays.
    """
    if len(features) == 0 or len(entries) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    if features.descriptors.dtype == np.uint8:
        searched = index or hamming_index(_binary(entries), owner, divided=False)
        landmark, nearest, other = nearest_two(_binary(features), searched)
        limit = options.ratio * np.where(other == FAR, _worst(features), other)
        return _one_to_one(
            np.flatnonzero((landmark >= 0) & (nearest < limit)),
            landmark.astype(np.intp),
            nearest.astype(np.float64),
        )
    nearest, distance, second = _nearest_two(features, entries, owner)
    limit = options.ratio * np.where(np.isfinite(second), second, _worst(features))
    return _one_to_one(np.flatnonzero(distance < limit), owner[nearest], distance)


def match_guided(
    features: Features,
    entries: Features,
    owner: Index,
    predicted_px: Array,
    radius_px: float,
    options: MatchOptions,
) -> tuple[Index, Index]:
    """Match an image against landmarks whose positions in it are predicted.

    Args:
        features: of the image.
        entries: M descriptors of the map.
        owner: (M,) landmark of each entry.
        predicted_px: (L, 2) where each landmark should appear in the raw image;
            NaN where it cannot.
        radius_px: how far from there to look.
        options: ``guided_ratio`` among the candidates of one landmark.

    Returns:
        (K,) features and (K,) landmarks, one to one.
    """
    visible = np.flatnonzero(np.isfinite(predicted_px[owner, 0]))
    if len(features) == 0 or len(visible) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    predicted = cKDTree(predicted_px[owner[visible]])
    near = predicted.sparse_distance_matrix(
        cKDTree(features.pixels), radius_px, output_type="ndarray"
    )
    if len(near) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    entry = visible[near["i"]]
    candidate = np.asarray(near["j"], dtype=np.intp)
    distance = _distances(entries, entry, features, candidate)
    landmark = owner[entry]
    # Best and second best *feature* of each landmark over all its entries.
    order = np.lexsort((distance, candidate, landmark))
    landmark, candidate, distance = landmark[order], candidate[order], distance[order]
    first_of_pair = np.ones(len(order), dtype=bool)
    first_of_pair[1:] = (landmark[1:] != landmark[:-1]) | (candidate[1:] != candidate[:-1])
    landmark, candidate, distance = (
        landmark[first_of_pair],
        candidate[first_of_pair],
        distance[first_of_pair],
    )
    order = np.lexsort((distance, landmark))
    landmark, candidate, distance = landmark[order], candidate[order], distance[order]
    first = np.ones(len(landmark), dtype=bool)
    first[1:] = landmark[1:] != landmark[:-1]
    start = np.flatnonzero(first)
    end = np.append(start[1:], len(landmark))
    second = np.where(
        end - start > 1, distance[np.minimum(start + 1, len(distance) - 1)], _worst(features)
    )
    ok = distance[start] < options.guided_ratio * np.minimum(second, _worst(features))
    chosen = start[ok]
    pick, _ = _one_to_one(np.arange(len(chosen)), candidate[chosen], distance[chosen])
    return candidate[chosen][pick], landmark[chosen][pick]


def _binary(features: Features) -> NDArray[np.uint8]:
    return np.asarray(features.descriptors, dtype=np.uint8)


def _worst(features: Features) -> float:
    """Return a distance between unrelated descriptors: what a lone candidate has to beat."""
    if features.descriptors.dtype == np.uint8:
        return 0.33 * 8 * int(features.descriptors.shape[1])
    return 0.9


def _nearest_of(a: Features, b: Features) -> tuple[Index, Array, Array]:
    """Return (N,) the nearest of ``b`` to each of ``a``, its distance, and the next one's."""
    everyone = np.arange(len(b))
    if a.descriptors.dtype == np.uint8:
        searched = hamming_index(_binary(b), everyone, divided=False)
        nearest, distance, second = nearest_two(_binary(a), searched)
        return nearest.astype(np.intp), distance.astype(float), second.astype(float)
    return _nearest_two(a, b, everyone)


def _nearest_two(features: Features, entries: Features, owner: Index) -> tuple[Index, Array, Array]:
    """Return (N,) nearest entries, their distances, and those of the nearest of another owner.

    By one product of matrices for some features at a time: for descriptors of numbers that
    is many times faster than looking at one pair after the other.
    """
    n = len(features)
    nearest = np.empty(n, dtype=np.intp)
    squared, other = np.empty(n), np.empty(n)
    sizes = np.einsum("md,md->m", entries.descriptors, entries.descriptors)
    for begin in range(0, n, _AT_ONCE):
        part = features.descriptors[begin : begin + _AT_ONCE]
        rows = np.arange(len(part))
        apart = sizes - 2.0 * (part @ entries.descriptors.T)
        best = apart.argmin(axis=1)
        least = apart[rows, best]
        apart[owner[best][:, None] == owner] = np.inf
        own = np.einsum("nd,nd->n", part, part)
        here = slice(begin, begin + len(part))
        nearest[here], squared[here], other[here] = best, least + own, apart.min(axis=1) + own
    return nearest, np.sqrt(np.maximum(squared, 0.0)), np.sqrt(np.maximum(other, 0.0))


def _distances(a: Features, i: Index, b: Features, j: Index) -> Array:
    """Return (P,) distances of descriptor pairs."""
    if a.descriptors.dtype == np.uint8:
        different = np.bitwise_xor(a.descriptors[i], b.descriptors[j])
        return np.asarray(np.bitwise_count(different).sum(axis=1), dtype=np.float64)
    return np.asarray(np.linalg.norm(a.descriptors[i] - b.descriptors[j], axis=1), dtype=np.float64)


def _one_to_one(candidates: Index, target: Index, distance: Array) -> tuple[Index, Index]:
    """Keep, of the candidates that chose one target, the closest.

    Args:
        candidates: (K,) sources that passed their test.
        target: (N,) what each source chose.
        distance: (N,) how well.
    """
    order = candidates[np.lexsort((candidates, distance[candidates], target[candidates]))]
    first = np.ones(len(order), dtype=bool)
    first[1:] = target[order][1:] != target[order][:-1]
    keep = np.sort(order[first])
    return keep, target[keep]
