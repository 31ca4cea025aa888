"""The features of images that maps are made of, found once however often a map is touched.

A round, the index of what it made, and the next round look at the same images
again and again; finding their features was half of an update's time.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.landmark_map import Keyframe
from vcl_companion.vision.features import Detector, FeatureOptions, Features, detect
from vcl_companion.vision.patch_tables import Pyramid, pyramid_of


@dataclass(frozen=True, eq=False)
class _Halved:
    pixels: Array
    descriptors: NDArray[np.float16]


class FeatureMemory:
    """Remembers the features of the images asked for last; for one thread.

    Args:
        options: how they are found.
        n_images: how many images are remembered, under a megabyte each with AKAZE and SIFT;
            fewer than are asked for again and again, and none of them is of use.
    """

    def __init__(self, options: FeatureOptions, n_images: int = 40) -> None:
        self._options = options
        self._n_images = n_images
        self._known: dict[tuple[bytes, int, int], dict[Detector, Features | _Halved]] = {}
        self._pyramids: dict[tuple[bytes, int, int], Pyramid] = {}

    def features(self, image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        """Return what a detector finds in an encoded image.

        Raises:
            ValueError: it is no image, or not one of this camera.
        """
        key = (image_bytes, camera.width_px, camera.height_px)
        known = self._known.pop(key, {})
        if detector not in known:
            pyramid = self._pyramids.get(key)
            image = decode_image(image_bytes, camera) if pyramid is None else pyramid.image
            known[detector] = _compact(detect(image, detector, self._options))
        self._known[key] = known  # the last one asked for is the last to go
        while len(self._known) > self._n_images:
            del self._known[next(iter(self._known))]
        return _unpacked(known[detector])

    def keep_only(self, images: Collection[bytes]) -> None:
        """Forget the features of all encoded images but some."""
        self._known = {key: known for key, known in self._known.items() if key[0] in images}

    def pyramid(self, image_bytes: bytes, camera: Camera) -> Pyramid:
        """Return an encoded image at all resolutions.

        Raises:
            ValueError: it is no image, or not one of this camera.
        """
        key = (image_bytes, camera.width_px, camera.height_px)
        pyramid = self._pyramids.pop(key, None)
        if pyramid is None:
            pyramid = pyramid_of(decode_image(image_bytes, camera))
        self._pyramids[key] = pyramid
        while len(self._pyramids) > self._n_images:
            del self._pyramids[next(iter(self._pyramids))]
        return pyramid

    def of_keyframe(
        self, keyframe: Keyframe, detectors: tuple[Detector, ...]
    ) -> tuple[Features, ...]:
        """Return what each detector finds in a keyframe; nothing where its image is none."""
        try:
            return tuple(
                self.features(keyframe.image_bytes, keyframe.camera, detector)
                for detector in detectors
            )
        except ValueError:
            nothing = np.zeros((1, 1), np.uint8)
            return tuple(detect(nothing, detector, self._options) for detector in detectors)


def _compact(features: Features) -> Features | _Halved:
    """Keep descriptors of numbers in half the bytes: to a thousandth is enough."""
    if features.descriptors.dtype != np.float32:
        return features
    return _Halved(features.pixels, features.descriptors.astype(np.float16))


def _unpacked(kept: Features | _Halved) -> Features:
    if isinstance(kept, Features):
        return kept
    return Features(kept.pixels, kept.descriptors.astype(np.float32))
