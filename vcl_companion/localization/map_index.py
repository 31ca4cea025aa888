"""A map made ready to be recognised: descriptors and covariance, derived once per revision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.vision.features import Detector, FeatureOptions, Features, detect
from vcl_companion.vision.hamming import HammingIndex, hamming_index

# Patches say better than the detector where its features are.
_SAME_PX = 1.0


@dataclass(frozen=True, eq=False)
class MapIndex:
    """What localization needs of a map.

    Attributes:
        landmark_map: the map.
        uncertainty: its joint covariance.
        landmark_covariances: (N, 3, 3) marginals, m^2.
        entries: M descriptors, one for each keyframe that a landmark was recognised in.
        owner: (M,) landmark of each entry.
        detector: what made the descriptors.
        search: the descriptors as they are searched; None when they are not binary.
        fallback: the same map by another detector, tried when this one fails; None for none.
    """

    landmark_map: LandmarkMap
    uncertainty: MapUncertainty
    landmark_covariances: Array
    entries: Features
    owner: NDArray[np.intp]
    detector: Detector
    search: HammingIndex | None = None
    fallback: MapIndex | None = None

    def of_the_same_map(self, other: MapIndex) -> MapIndex:
        """Return this index, and what it falls back on, with another one's copy of the map."""
        fallback = self.fallback
        return replace(
            self,
            landmark_map=other.landmark_map,
            uncertainty=other.uncertainty,
            landmark_covariances=other.landmark_covariances,
            fallback=None if fallback is None else fallback.of_the_same_map(other),
        )


def index_map(
    landmark_map: LandmarkMap,
    detector: Detector,
    options: FeatureOptions,
    features_of: Callable[[Keyframe], Features] | None = None,
    uncertainty: MapUncertainty | None = None,
) -> MapIndex:
    """Derive descriptors from the keyframe images, and the covariance from the geometry.

    Args:
        landmark_map: any revision.
        detector: the localization's own; landmarks of other detectors serve
            the geometry only.
        options: as used when the map was built.
        features_of: knows what this detector finds in a keyframe; None: it is looked for.
        uncertainty: of the map, if that is known already.

    Raises:
        ValueError: an image cannot be decoded, or the map is not determined.
    """
    descriptors, pixels, owners = [], [], []
    for i, keyframe in enumerate(landmark_map.keyframes):
        if features_of is None:
            image = decode_image(keyframe.image_bytes, keyframe.camera)
            features = detect(image, detector, options)
        else:
            features = features_of(keyframe)
        seen = np.flatnonzero(landmark_map.seen[:, i])
        if len(features) == 0 or len(seen) == 0:
            continue
        distance, nearest = cKDTree(features.pixels).query(landmark_map.observed_px[seen, i])
        nearest, found = np.atleast_1d(nearest), distance < _SAME_PX
        descriptors.append(features.descriptors[nearest[found]])
        pixels.append(features.pixels[nearest[found]])
        owners.append(seen[found])
    if not owners or sum(map(len, owners)) == 0:
        raise ValueError(f"the map has no landmark that {detector} finds again in its keyframes")
    uncertainty = uncertainty or map_uncertainty(landmark_map)
    entries = Features(np.concatenate(pixels), np.concatenate(descriptors))
    owner = np.concatenate(owners).astype(np.intp)
    search = None
    if entries.descriptors.dtype == np.uint8:
        search = hamming_index(np.asarray(entries.descriptors, dtype=np.uint8), owner)
    return MapIndex(
        landmark_map, uncertainty, uncertainty.marginal(), entries, owner, detector, search
    )
