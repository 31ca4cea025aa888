"""Interest points and their descriptors (IV-A): AKAZE, SIFT or ORB, interchangeable."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array

Detector = Literal["akaze", "sift", "orb"]
Image = NDArray[np.uint8]

# OpenCV's AKAZE corrupts memory on an image one pixel high, and images come from peers.
_MIN_SIDE_PX = 32

# For a moment AKAZE takes 30 MB for an image of 640 x 480: one thread after the other.
_one_at_a_time = threading.Lock()
# SIFT takes 200 bytes a pixel, so it looks at tiles: of about this size, cut at a multiple of what
# its coarser octaves leave out, with so much of the image around each as all but one in a hundred
# features of a sharp image reach (coarser ones near a cut are a little displaced, or missing).
_TILE_PX, _TILES_STAND_AT_PX, _BEYOND_TILE_PX = (320, 240), 16, 32


@dataclass(frozen=True)
class FeatureOptions:
    """How features are found.

    Attributes:
        max_features: the strongest are kept, spread over the image.
        akaze_threshold: smallest determinant-of-Hessian response of AKAZE.
        sift_contrast: smallest contrast of SIFT.
    """

    max_features: int = 2500
    akaze_threshold: float = 0.0001
    sift_contrast: float = 0.02

    def __post_init__(self) -> None:
        if not 50 <= self.max_features <= 20_000:
            raise ValueError(f"max_features must lie in 50..20000, got {self.max_features}")
        if not 0 < self.akaze_threshold < 1 or not 0 < self.sift_contrast < 1:
            raise ValueError("akaze_threshold and sift_contrast must lie between 0 and 1")


@dataclass(frozen=True, eq=False)
class Features:
    """What a detector found in one image.

    Attributes:
        pixels: (N, 2) positions in the raw image, px.
        descriptors: (N, D) uint8 for AKAZE and ORB (Hamming), float32 for SIFT (L2).
    """

    pixels: Array
    descriptors: NDArray[np.uint8] | NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.pixels)

    def subset(self, index: NDArray[np.intp]) -> Features:
        """Return the features at (M,) positions, in that order."""
        return Features(self.pixels[index], self.descriptors[index])


def joined_features(parts: list[Features]) -> Features:
    """Return the features of several images as one set, one after the other."""
    descriptors = np.concatenate([part.descriptors for part in parts])
    return Features(np.concatenate([part.pixels for part in parts]), descriptors)


def detect(image: Image, detector: Detector, options: FeatureOptions) -> Features:
    """Find features in a grey image.

    Args:
        image: (H, W) uint8.
        detector: which kind.
        options: how many and how strong.

    Returns:
        At most ``max_features`` of them, kept strongest first within each tile
        of an 8 x 6 grid, so that a rich corner of the image cannot take all
        places; none in an image too small to hold any. SIFT may put several, one
        per dominant direction, at one position.
    """
    height, width = image.shape
    if min(height, width) < _MIN_SIDE_PX:
        return _none(detector)
    most_px = _TILE_PX if detector == "sift" else (width, height)
    parts, responses = [_none(detector)], [np.zeros(0)]
    for top, bottom in _portions(height, most_px[1]):
        for left, right in _portions(width, most_px[0]):
            x, y = max(left - _BEYOND_TILE_PX, 0), max(top - _BEYOND_TILE_PX, 0)
            tile = image[y : bottom + _BEYOND_TILE_PX, x : right + _BEYOND_TILE_PX]
            found, response = _detected(tile, detector, options)
            pixels = found.pixels + np.array([x, y])
            is_own = np.all((pixels >= (left, top)) & (pixels < (right, bottom)), axis=1)
            parts.append(Features(pixels[is_own], found.descriptors[is_own]))
            responses.append(response[is_own])
    features, response = joined_features(parts), np.concatenate(responses)
    return features.subset(_spread(features.pixels, response, width, height, options.max_features))


def _portions(length_px: int, most_px: int) -> Iterator[tuple[int, int]]:
    """Return begin and end of equal parts of an image's side, hardly longer than they may be."""
    n, step = -(-length_px // most_px), _TILES_STAND_AT_PX
    cuts = (round(i * length_px / n / step) * step for i in range(1, n))
    return itertools.pairwise((0, *cuts, length_px))


def _detected(image: Image, detector: Detector, options: FeatureOptions) -> tuple[Features, Array]:
    """Find all features of an image, and how strong they are."""
    with _one_at_a_time:
        keypoints, found = _engine(detector, options).detectAndCompute(image, None)
    if found is None or len(keypoints) == 0:
        return _none(detector), np.zeros(0)
    pixels = np.array([k.pt for k in keypoints], dtype=np.float64)
    response = np.array([k.response for k in keypoints])
    descriptors: NDArray[np.uint8] | NDArray[np.float32]
    if detector == "sift":
        descriptors = _root_sift(np.asarray(found, dtype=np.float32))
    else:
        descriptors = np.asarray(found, dtype=np.uint8)
    return Features(pixels, descriptors), response


def _none(detector: Detector) -> Features:
    if detector == "sift":
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    return Features(np.zeros((0, 2)), np.zeros((0, 61 if detector == "akaze" else 32), np.uint8))


def _engine(detector: Detector, options: FeatureOptions) -> cv2.Feature2D:
    if detector == "akaze":
        # OpenCV 5 moved AKAZE to contrib's xfeatures2d, byte-identical.
        home = cv2 if hasattr(cv2, "AKAZE") else getattr(cv2, "xfeatures2d")  # noqa: B009
        akaze: cv2.Feature2D = home.AKAZE.create(threshold=options.akaze_threshold)
        return akaze
    if detector == "sift":
        # Without precise upscaling OpenCV's SIFT sits 0.25 px right of and below the truth.
        return cv2.SIFT.create(contrastThreshold=options.sift_contrast, enable_precise_upscale=True)
    # ORB keeps the strongest by itself, wherever they are: more, for us to spread.
    return cv2.ORB.create(nfeatures=4 * options.max_features, fastThreshold=10)


def _root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Hellinger kernel (Arandjelovic and Zisserman 2012): plain L2 then matches better."""
    scaled = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-6)
    return np.asarray(np.sqrt(scaled), dtype=np.float32)


def _spread(
    pixels: Array, response: Array, width: int, height: int, max_features: int
) -> NDArray[np.intp]:
    """Return indices of the features to keep, in a deterministic order."""
    n = len(pixels)
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response))
    if n <= max_features:
        return order
    tile = (pixels[:, 0] * 8 // width).astype(int) + 8 * (pixels[:, 1] * 6 // height).astype(int)
    rank = np.empty(n, dtype=np.intp)
    for t in np.unique(tile):
        members = order[tile[order] == t]
        rank[members] = np.arange(len(members))
    by_rank = np.lexsort((np.argsort(order), rank))
    return by_rank[:max_features]
