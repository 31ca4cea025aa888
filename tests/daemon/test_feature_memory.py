"""Features found once: the same as found anew, bounded, and never of a wrong image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.vision.features import detect
from vcl_companion.wire.map_codec import decode_map

IMAGE, CAMERA = demo.answer(2).image_bytes, demo.sensor(2).camera


def test_what_is_remembered_is_what_is_found() -> None:
    memory = FeatureMemory(demo.FEATURES)
    first = memory.features(IMAGE, CAMERA, "akaze")
    anew = detect(decode_image(IMAGE, CAMERA), "akaze", demo.FEATURES)
    assert np.array_equal(first.pixels, anew.pixels)
    assert np.array_equal(first.descriptors, anew.descriptors)
    assert memory.features(bytes(bytearray(IMAGE)), CAMERA, "akaze") is first
    assert memory.features(IMAGE, CAMERA, "orb").descriptors.shape[1] == 32
    assert memory.features(IMAGE, CAMERA, "akaze") is first


def test_features_of_an_image_that_was_decoded_before_are_the_same() -> None:
    memory = FeatureMemory(demo.FEATURES)
    pyramid = memory.pyramid(IMAGE, CAMERA)
    image = decode_image(IMAGE, CAMERA)
    assert np.array_equal(pyramid.image, image)
    found, anew = memory.features(IMAGE, CAMERA, "akaze"), detect(image, "akaze", demo.FEATURES)
    assert np.array_equal(found.pixels, anew.pixels)
    assert np.array_equal(found.descriptors, anew.descriptors)


def test_the_image_that_was_asked_for_longest_ago_is_forgotten() -> None:
    memory = FeatureMemory(demo.FEATURES, n_images=2)
    images = [demo.answer(system_id).image_bytes for system_id in (1, 2, 3)]
    one, two = (memory.features(image, CAMERA, "orb") for image in images[:2])
    assert memory.features(images[0], CAMERA, "orb") is one
    memory.features(images[2], CAMERA, "orb")
    assert memory.features(images[0], CAMERA, "orb") is one
    assert memory.features(images[1], CAMERA, "orb") is not two


def test_what_is_no_more_in_a_map_is_forgotten_and_the_rest_is_not() -> None:
    memory = FeatureMemory(demo.FEATURES)
    images = [demo.answer(system_id).image_bytes for system_id in (1, 2)]
    one, two = (memory.features(image, CAMERA, "orb") for image in images)
    memory.keep_only({images[0]})
    assert memory.features(images[0], CAMERA, "orb") is one
    assert memory.features(images[1], CAMERA, "orb") is not two


def test_a_known_image_of_another_camera_is_as_wrong_as_an_unknown_one() -> None:
    memory = FeatureMemory(demo.FEATURES)
    memory.features(IMAGE, CAMERA, "orb")
    other = replace(CAMERA, width_px=CAMERA.width_px + 1)
    for image, camera in ((IMAGE, other), (b"no image", CAMERA)):
        with pytest.raises(ValueError, match="image"):
            memory.features(image, camera, "orb")


def test_a_keyframe_whose_image_is_none_shows_nothing() -> None:
    memory = FeatureMemory(demo.FEATURES)
    keyframe = decode_map(demo.encoded_map(1, 2)).keyframes[0]
    akaze, orb = memory.of_keyframe(keyframe, ("akaze", "orb"))
    assert len(akaze) > 100
    assert len(orb) > 100
    broken = replace(keyframe, image_bytes=b"no image")
    assert [len(found) for found in memory.of_keyframe(broken, ("akaze", "orb"))] == [0, 0]
