"""The features of a map's keyframes: computed from their images again, and whose landmarks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.vision.features import Detector, FeatureOptions, Features, detect

Index = NDArray[np.intp]
FeaturesOf = Callable[[Keyframe], tuple[Features, ...]]

# Patches say better than the detector where its features are.
_SAME_PX = 1.0


@dataclass(frozen=True, eq=False)
class KnownFeatures:
    """What one keyframe's image shows.

    Attributes:
        features: one set for each detector.
        pixels: (M, 2) of all of them, one detector after the other.
        landmark: (M,) landmark that each of them is, -1 for none.
    """

    features: tuple[Features, ...]
    pixels: Array
    landmark: Index


def of_keyframes(
    features_of: Callable[[bytes, Camera, Detector], Features], detectors: tuple[Detector, ...]
) -> FeaturesOf:
    """Return what finds a keyframe's features; none where its image is none."""

    def found(keyframe: Keyframe) -> tuple[Features, ...]:
        try:
            return tuple(features_of(keyframe.image_bytes, keyframe.camera, d) for d in detectors)
        except ValueError:
            # A map may come from a peer; what it shows nothing of, nothing is matched with.
            nothing = np.zeros((1, 1), np.uint8)
            return tuple(detect(nothing, d, FeatureOptions()) for d in detectors)

    return found


class KeyframeLibrary:
    """The features of one map's keyframes, computed when they are first asked for.

    Args:
        landmark_map: the map.
        features_of: finds the features of a keyframe.
    """

    def __init__(self, landmark_map: LandmarkMap, features_of: FeaturesOf) -> None:
        self._map = landmark_map
        self._features_of = features_of
        self._read: dict[int, KnownFeatures] = {}

    @property
    def read(self) -> dict[int, KnownFeatures]:
        """Keyframes asked for so far."""
        return dict(self._read)

    def of(self, k: int) -> KnownFeatures:
        """Return the features of keyframe ``k``."""
        if k not in self._read:
            features = self._features_of(self._map.keyframes[k])
            pixels = np.concatenate([f.pixels for f in features])
            landmark = np.full(len(pixels), -1, dtype=np.intp)
            seen = np.flatnonzero(self._map.seen[:, k])
            if len(seen) and len(pixels):
                distance, nearest = cKDTree(self._map.observed_px[seen, k]).query(pixels)
                same = distance < _SAME_PX
                landmark[same] = seen[np.asarray(nearest, dtype=np.intp)[same]]
            self._read[k] = KnownFeatures(features, pixels, landmark)
        return self._read[k]
