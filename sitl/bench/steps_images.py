"""Features and their matches, beside OpenCV's."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.bench.inputs import DETECTORS, FEATURES, MATCHING, Inputs, View
from sitl.bench.timing import Accuracy, Entry
from vcl_companion.vision.essential import sampson_px
from vcl_companion.vision.features import Detector, Features, detect
from vcl_companion.vision.matching import match_guided, match_mutual, match_to_entries

Index = NDArray[np.intp]
Pairs = tuple[Index, Index]

_RIGHT_PX = 2.0
_RIGHT_LANDMARK_PX = 4.0
_LEAST_MATCHES = 200
# A cross check alone lets many a wrong match pass, and is meant to.
_LEAST_SHARE = 0.5
_RADIUS_PX = 20.0


def detection(inputs: Inputs) -> list[Entry]:
    """Find features in one image: our detectors, and AKAZE as OpenCV gives it."""
    image = inputs.a.image

    def entry(name: str, run: Callable[[], Features], other: Features) -> Entry:
        def judge(found: Features) -> Accuracy:
            pairs = match_mutual(found, other, MATCHING)
            matched = _judge_pairs(inputs, found, other)(pairs)
            return Accuracy(f"{len(found)} features, {matched.text}", matched.right)

        return Entry(name, run, judge)

    def ours(detector: Detector) -> Callable[[], Features]:
        return lambda: detect(image, detector, FEATURES)

    def bare() -> Features:
        keypoints, descriptors = akaze.detectAndCompute(image, None)
        pixels = np.array(cv2.KeyPoint.convert(keypoints), dtype=np.float64)
        return Features(pixels, np.asarray(descriptors, dtype=np.uint8))

    akaze = cv2.AKAZE.create(threshold=FEATURES.akaze_threshold)
    entries = [
        entry("ours, AKAZE" if name == "akaze" else f"ours, {name.upper()}", ours(name),
              inputs.b.features[name])
        for name in DETECTORS
    ]  # fmt: skip
    entries.insert(1, entry("cv2 AKAZE, same options", bare, inputs.b.features["akaze"]))
    return entries


def matching(inputs: Inputs) -> list[Entry]:
    """Match two images: each other's best."""
    a, b = inputs.a.features["akaze"], inputs.b.features["akaze"]
    crossed = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    judge = _judge_pairs(inputs, a, b)
    return [
        Entry("ours", lambda: match_mutual(a, b, MATCHING), judge),
        Entry("cv2 BFMatcher crossCheck", lambda: _crossed(crossed, a, b), judge),
    ]


def guided_matching(inputs: Inputs) -> list[Entry]:
    """Match an image against the map: near predictions, everywhere, and by OpenCV."""
    features, index = inputs.frame.features["akaze"], inputs.index
    points = inputs.landmark_map.points_world
    truth_px = inputs.frame.camera.project(inputs.frame.cam_from_world.apply(points))
    # Off by as much as a prediction usually is.
    predicted_px = truth_px + np.array([3.0, -2.0])
    crossed = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)

    def by_cv2() -> Pairs:
        i, entry = _crossed(crossed, features, index.entries)
        return i, index.owner[entry]

    def judge(pairs: Pairs) -> Accuracy:
        error = np.linalg.norm(features.pixels[pairs[0]] - truth_px[pairs[1]], axis=1)
        return _judged(error < _RIGHT_LANDMARK_PX)

    return [
        Entry(
            "ours, guided",
            lambda: match_guided(
                features, index.entries, index.owner, predicted_px, _RADIUS_PX, MATCHING
            ),
            judge,
        ),
        Entry(
            "ours, whole map",
            lambda: match_to_entries(features, index.entries, index.owner, MATCHING),
            judge,
        ),
        Entry("cv2 BFMatcher crossCheck", by_cv2, judge),
    ]


def _crossed(matcher: cv2.BFMatcher, a: Features, b: Features) -> Pairs:
    found = matcher.match(a.descriptors, b.descriptors)
    return (
        np.array([match.queryIdx for match in found], dtype=np.intp),
        np.array([match.trainIdx for match in found], dtype=np.intp),
    )


def _judge_pairs(inputs: Inputs, a: Features, b: Features) -> Callable[[Pairs], Accuracy]:
    """Return who judges matches of the two images by their true relative pose."""

    def judge(pairs: Pairs) -> Accuracy:
        ideal_a, ideal_b = _ideal(inputs.a, a, pairs[0]), _ideal(inputs.b, b, pairs[1])
        error = sampson_px(inputs.b_from_a, ideal_a, ideal_b, inputs.a.camera.focal_px)
        return _judged(np.abs(error) < _RIGHT_PX)

    return judge


def _ideal(view: View, features: Features, index: Index) -> NDArray[np.float64]:
    return view.camera.ideal_from_pixels(np.asarray(features.pixels[index], dtype=np.float64))


def _judged(right: NDArray[np.bool_]) -> Accuracy:
    share = float(right.mean()) if len(right) else 0.0
    good = share > _LEAST_SHARE and int(right.sum()) >= _LEAST_MATCHES
    return Accuracy(f"{len(right)} matches, {share:.1%} right", good)
