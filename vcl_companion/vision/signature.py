"""A frame in 48 bytes: by two of them two drones tell whether they see the same place.

The image is made small, so that what is left is large, seen by others too, and found in
some ms; its 16 strongest AKAZE points each give 24 bits of their descriptor, which is
locality-sensitive hashing by bit sampling (Indyk and Motwani 1998). Two frames are as like as
the number of points that have a like one in the other frame: at most 3 bits apart.

One pair of frames says little: of those that share much one in three is found out, where one
in a hundred of all others would be. It is to be added up over some seconds, as logarithms of
likelihood ratios. Two frames that share nothing are more alike than chance has it, because
windows are like windows: by the binomial ``chance`` of unrelated bits three in a hundred such
pairs have a point in common, of photographs two in five.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.vision.features import FeatureOptions, Image, detect

SIGNATURE_BYTES = 48

_POINT_BYTES = 3
POINTS = SIGNATURE_BYTES // _POINT_BYTES
"""Of a frame that go into its signature, at most."""

# Of a frame with fewer points nothing can be told.
_FEWEST_POINTS = 8
# The longer side of the image that is looked at, px.
_SIDE_PX = 213
# Every 20th of AKAZE's 486 bits: some of each of its grids and channels.
_BITS = 7 + 20 * np.arange(8 * _POINT_BYTES)
_FEATURES = FeatureOptions(max_features=5000, akaze_threshold=0.0005)
_MOST_BITS_APART = 3

# How much more often frames of one place (at most 25 degrees and a factor of 1.5 apart) have
# so many points in common than frames of two, natural logarithm; the last for all beyond.
_LOG_RATIO = np.array([-0.6, -0.5, -0.1, 0.5, 1.9, 3.0])


def signature_of(image: Image) -> bytes:
    """Return the signature of a grey image.

    Args:
        image: (H, W) uint8, of any size.

    Returns:
        24 to 48 bytes, 3 a point, strongest first; none of an image with too few points.
    """
    height, width = image.shape[:2]
    scale = _SIDE_PX / max(height, width)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    descriptors = detect(small, "akaze", _FEATURES).descriptors[:POINTS]
    if len(descriptors) < _FEWEST_POINTS:
        return b""
    bits = np.unpackbits(np.asarray(descriptors, dtype=np.uint8), axis=1)
    return np.packbits(bits[:, _BITS], axis=1).tobytes()


def is_signature(data: bytes) -> bool:
    """Whether bytes are a signature; any that are of a right length are."""
    return len(data) % _POINT_BYTES == 0 and _FEWEST_POINTS <= len(data) // _POINT_BYTES <= POINTS


def words_of(signature: bytes) -> NDArray[np.int32]:
    """Return (16,) the points of a signature, -1 for those that it lacks."""
    words = np.full(POINTS, -1, dtype=np.int32)
    points = np.frombuffer(signature, dtype=np.uint8).reshape(-1, _POINT_BYTES).astype(np.int32)
    words[: len(points)] = points @ np.array([1 << 16, 1 << 8, 1], dtype=np.int32)
    return words


def likeness(words: NDArray[np.int32], others: NDArray[np.int32]) -> NDArray[np.intp]:
    """Return how many points a frame has in common with each of some others.

    Args:
        words: (16,) of ``words_of``.
        others: (M, 16) of the others.

    Returns:
        (M,) points with a like one in the other frame, counted in the frame that has fewer.
    """
    apart = np.bitwise_count(others[:, :, None] ^ words)
    there = (others >= 0)[:, :, None] & (words >= 0)
    alike = (apart <= _MOST_BITS_APART) & there
    ours, theirs = alike.any(axis=1).sum(axis=1), alike.any(axis=2).sum(axis=1)
    return np.asarray(np.minimum(ours, theirs), dtype=np.intp)


def chance(n_common: int) -> float:
    """Return the probability that two signatures of random bits have so many points in common.

    A point is like one of the 16 others by chance once in 450 times; whether the next is too
    does not depend on it.
    """
    bits = 8 * _POINT_BYTES
    near = sum(math.comb(bits, k) for k in range(_MOST_BITS_APART + 1)) / (1 << bits)
    p = 1.0 - (1.0 - near) ** POINTS
    return math.fsum(
        math.comb(POINTS, k) * p**k * (1.0 - p) ** (POINTS - k) for k in range(n_common, POINTS + 1)
    )


def log_likelihood_ratios(
    words: NDArray[np.int32], others: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Return (M,) how much speaks for a frame showing the same place as each of some others."""
    n_common = likeness(words, others)
    return np.asarray(_LOG_RATIO[np.minimum(n_common, len(_LOG_RATIO) - 1)])
