"""Images as they are exchanged, and what may come instead of one."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.drone_view import DroneView, decode_image, encode_image
from vcl_companion.vision.features import Features, Image
from vcl_companion.vision.image_shift import shift_px

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)


def texture(camera: Camera = CAMERA) -> Image:
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 256, (camera.height_px // 8, camera.width_px // 8), dtype=np.uint8)
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


@pytest.mark.parametrize(("quality", "worst_levels"), [(20, 25.0), (80, 12.0), (100, 6.0)])
def test_a_round_trip_keeps_the_image(quality: int, worst_levels: float) -> None:
    image = texture()
    decoded = decode_image(encode_image(image, quality), CAMERA)
    assert decoded.dtype == np.uint8
    assert decoded.shape == image.shape
    error = np.abs(decoded.astype(float) - image)
    assert error.mean() < worst_levels / 4
    assert np.quantile(error, 0.99) < worst_levels


def test_better_quality_is_more_bytes_and_less_error() -> None:
    image = texture()
    coarse, fine = encode_image(image, 20), encode_image(image, 90)
    assert len(coarse) < len(fine)
    errors = [np.abs(decode_image(b, CAMERA).astype(float) - image).mean() for b in (coarse, fine)]
    assert errors[1] < errors[0]


def test_every_receiver_decodes_the_same_pixels() -> None:
    data = encode_image(texture(), 50)
    np.testing.assert_array_equal(decode_image(data, CAMERA), decode_image(data, CAMERA))


@pytest.mark.parametrize("quality", [20, 36, 80])
def test_what_is_decoded_lies_where_it_was(quality: int) -> None:
    """The encoder alone would put it to the right and below."""
    rng = np.random.default_rng(8)
    drifts = []
    for _ in range(4):
        light = cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 2.0)
        image = np.asarray(np.clip(128.0 + 200.0 * light, 0, 255), np.uint8)
        plain = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
        both = (np.asarray(plain), np.frombuffer(encode_image(image, quality), np.uint8))
        decoded = [np.asarray(cv2.imdecode(b, cv2.IMREAD_GRAYSCALE), np.uint8) for b in both]
        drifts.append([shift_px(image, one) for one in decoded])
    plain_px, ours_px = np.mean(drifts, axis=0)
    assert (plain_px > 0.002).all(), plain_px
    assert np.linalg.norm(ours_px) < 0.4 * np.linalg.norm(plain_px), (plain_px, ours_px)


def test_an_image_without_pixels_cannot_be_encoded() -> None:
    with pytest.raises((ValueError, cv2.error)):
        encode_image(np.zeros((0, 10), np.uint8), 80)


def test_another_size_than_the_camera_s_is_refused() -> None:
    data = encode_image(texture(Camera(320, 240, 100.0, 100.0, 79.5, 59.5)), 50)
    with pytest.raises(ValueError, match=r"160x120.*\(320, 240\)"):
        decode_image(data, CAMERA)


def test_an_image_takes_no_more_bytes_than_it_may() -> None:
    image = texture(Camera(640, 480, 400.0, 400.0, 319.5, 239.5))
    whole = len(encode_image(image, 80))
    for share in (0.4, 0.6, 0.9):
        data = encode_image(image, 80, round(share * whole))
        assert len(data) <= share * whole
        # The best that fits, not just any: of the qualities above it the next is too long.
        assert any(
            encode_image(image, q) == data and len(encode_image(image, q + 1)) > share * whole
            for q in range(1, 80)
        )
    assert encode_image(image, 80, whole) == encode_image(image, 80)
    assert encode_image(image, 80, 1) == encode_image(image, 1)


def test_a_header_that_claims_a_huge_image_is_refused_by_the_header() -> None:
    data = bytearray(encode_image(texture(), 50))
    struct.pack_into("<HH", data, 26, 16383, 16383)
    with pytest.raises(ValueError, match="16383, 16383"):
        decode_image(bytes(data), CAMERA)


def test_a_header_that_lies_about_the_pixels_inside_is_refused() -> None:
    """The size is the camera's, the compressed data are those of a smaller image."""
    small = Camera(16, 16, 10.0, 10.0, 7.5, 7.5)
    data = bytearray(encode_image(texture(small), 50))
    struct.pack_into("<HH", data, 26, CAMERA.width_px, CAMERA.height_px)
    with pytest.raises(ValueError, match="cannot be decoded"):
        decode_image(bytes(data), CAMERA)


def other_formats() -> list[bytes]:
    image = texture()
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    return [
        b"",
        b"RIFF",
        b"\0" * 64,
        bytes(cv2.imencode(".png", image)[1]),
        bytes(cv2.imencode(".jpg", image)[1]),
        bytes(cv2.imencode(".webp", image, lossless)[1]),
    ]


@pytest.mark.parametrize("data", other_formats(), ids=["", "RIFF", "0", "png", "jpg", "lossless"])
def test_what_is_no_lossy_webp_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="no WebP of 160x120: None"):
        decode_image(data, CAMERA)


@given(st.integers(0, 2000))
def test_truncated_bytes_are_refused_or_an_image_of_the_camera(length: int) -> None:
    data = encode_image(texture(), 50)
    assert len(data) > 1500
    try:
        image = decode_image(data[: min(length, len(data) - 1)], CAMERA)
    except ValueError:
        return
    assert image.shape == (120, 160)


def test_half_an_image_is_refused() -> None:
    data = encode_image(texture(), 50)
    with pytest.raises(ValueError, match="cannot be decoded"):
        decode_image(data[: len(data) // 2], CAMERA)


@given(st.data())
@settings(max_examples=200)
def test_mutated_bytes_are_refused_or_an_image_of_the_camera(data: st.DataObject) -> None:
    mutated = bytearray(encode_image(texture(), 30))
    for _ in range(data.draw(st.integers(1, 6))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        image = decode_image(bytes(mutated), CAMERA)
    except ValueError:
        return
    assert image.shape == (120, 160)


@given(st.binary(max_size=200))
def test_any_bytes_after_a_right_header_do_no_harm(tail: bytes) -> None:
    head = encode_image(texture(), 30)[:30]
    try:
        image = decode_image(head + tail, CAMERA)
    except ValueError:
        return
    assert image.shape == (120, 160)


def test_a_view_s_pixels_are_those_of_its_detectors_in_order() -> None:
    akaze = Features(np.array([[1.0, 2.0]]), np.zeros((1, 61), np.uint8))
    sift = Features(np.array([[3.0, 4.0], [5.0, 6.0]]), np.zeros((2, 128), np.float32))
    view = DroneView(1, 0, CAMERA, Pose.identity(), None, b"", (akaze, sift))
    np.testing.assert_array_equal(view.pixels, [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
