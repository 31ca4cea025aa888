"""Images as they are exchanged, and what may come instead of one."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.keyframe_image import (
    IMAGE_FORMATS,
    ImageFormat,
    decode_image,
    encode_image,
)
from vcl_companion.vision.features import Image

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)
each_format = pytest.mark.parametrize("image_format", IMAGE_FORMATS)


def texture(camera: Camera = CAMERA) -> Image:
    rng = np.random.default_rng(5)
    coarse = rng.integers(0, 256, (camera.height_px // 8, camera.width_px // 8), dtype=np.uint8)
    size = (camera.width_px, camera.height_px)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def encoded(quality: int, image_format: ImageFormat = "av1", camera: Camera = CAMERA) -> bytes:
    return encode_image(texture(camera), quality, image_format=image_format)


@each_format
@pytest.mark.parametrize(("quality", "worst_levels"), [(30, 25.0), (60, 12.0), (100, 6.0)])
def test_a_round_trip_keeps_the_image(
    image_format: ImageFormat, quality: int, worst_levels: float
) -> None:
    image = texture()
    decoded = decode_image(encoded(quality, image_format), CAMERA)
    assert decoded.dtype == np.uint8
    assert decoded.shape == image.shape
    error = np.abs(decoded.astype(float) - image)
    assert error.mean() < worst_levels / 4
    assert np.quantile(error, 0.99) < worst_levels


@each_format
def test_better_quality_is_more_bytes_and_less_error(image_format: ImageFormat) -> None:
    coarse, fine = encoded(20, image_format), encoded(90, image_format)
    assert len(coarse) < len(fine)
    errors = [
        np.abs(decode_image(data, CAMERA).astype(float) - texture()).mean()
        for data in (coarse, fine)
    ]
    assert errors[1] < errors[0]


@each_format
def test_every_receiver_decodes_the_same_pixels(image_format: ImageFormat) -> None:
    data = encoded(50, image_format)
    np.testing.assert_array_equal(decode_image(data, CAMERA), decode_image(data, CAMERA))


@each_format
def test_an_image_without_pixels_cannot_be_encoded(image_format: ImageFormat) -> None:
    with pytest.raises(ValueError, match="cannot be encoded"):
        encode_image(np.zeros((0, 10), np.uint8), 80, image_format=image_format)


@each_format
def test_another_size_than_the_camera_s_is_refused(image_format: ImageFormat) -> None:
    data = encoded(50, image_format, Camera(320, 240, 100.0, 100.0, 79.5, 59.5))
    with pytest.raises(ValueError, match=r"160x120.*\(320, 240\)"):
        decode_image(data, CAMERA)


@each_format
def test_an_image_takes_no_more_bytes_than_it_may(image_format: ImageFormat) -> None:
    image = texture(Camera(640, 480, 400.0, 400.0, 319.5, 239.5))

    def within(most_bytes: int | None, quality: int = 80) -> bytes:
        return encode_image(image, quality, most_bytes, image_format)

    whole = len(within(None))
    for share in (0.4, 0.6, 0.9):
        data = within(round(share * whole))
        assert len(data) <= share * whole
        # The best that fits, not just any: of the qualities above it the next is too long.
        assert any(
            within(None, q) == data and len(within(None, q + 1)) > share * whole
            for q in range(1, 80)
        )
    assert within(whole) == within(None)
    assert within(1) == within(None, 1)


def claimed(size_px: tuple[int, int]) -> bytes:
    """An AV1 picture of 160x120 whose header says another size, in as many bits as it takes."""
    data = encoded(50)
    header = int.from_bytes(data[2 : 2 + data[1]], "big")
    left = 8 * data[1] - 10
    widths = [((header >> left - 4) & 15) + 1, ((header >> left - 8) & 15) + 1]
    rest_bits = left - 8 - sum(widths)
    bits = f"{header >> left:010b}"
    for side in size_px:
        bits += f"{(side - 1).bit_length() - 1:04b}"
    bits += "".join(f"{side - 1:b}" for side in size_px)
    bits += f"{header & ((1 << rest_bits) - 1):0{rest_bits}b}"
    n_bytes = (len(bits) + 7) // 8
    return (
        bytes([0x0A, n_bytes])
        + int(bits.ljust(8 * n_bytes, "0"), 2).to_bytes(n_bytes, "big")
        + data[2 + data[1] :]
    )


def test_a_header_that_claims_a_huge_image_is_refused_by_the_header() -> None:
    assert decode_image(claimed((160, 120)), CAMERA).shape == (120, 160)
    with pytest.raises(ValueError, match="65536, 65536"):
        decode_image(claimed((65536, 65536)), CAMERA)
    webp = bytearray(encoded(50, "webp"))
    struct.pack_into("<HH", webp, 26, 16383, 16383)
    with pytest.raises(ValueError, match="16383, 16383"):
        decode_image(bytes(webp), CAMERA)


def test_a_header_that_lies_about_the_pixels_inside_is_refused() -> None:
    """The size is the camera's, the compressed data are those of a smaller image."""
    small = Camera(16, 16, 10.0, 10.0, 7.5, 7.5)
    data = bytearray(encoded(50, "webp", small))
    struct.pack_into("<HH", data, 26, CAMERA.width_px, CAMERA.height_px)
    with pytest.raises(ValueError, match="cannot be decoded"):
        decode_image(bytes(data), CAMERA)


def others() -> dict[str, bytes]:
    image, data = texture(), encoded(50)
    head, frame = data[: 2 + data[1]], data[2 + data[1] :]
    colour = cv2.imencode(".avif", cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))[1].tobytes()
    deep_options = [cv2.IMWRITE_AVIF_DEPTH, 10]
    deep = cv2.imencode(".avif", image.astype(np.uint16) * 4, deep_options)[1].tobytes()
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101]
    return {
        "nothing": b"",
        "RIFF": b"RIFF",
        "zeros": b"\0" * 64,
        "png": bytes(cv2.imencode(".png", image)[1]),
        "jpg": bytes(cv2.imencode(".jpg", image)[1]),
        "lossless webp": bytes(cv2.imencode(".webp", image, lossless)[1]),
        "a whole avif": cv2.imencode(".avif", image)[1].tobytes(),
        "colour": colour[colour.index(b"mdat\x12\0") + 6 :],
        "10 bits": deep[deep.index(b"mdat\x12\0") + 6 :],
        "no frame": head,
        "two sequences": head + data,
        "two frames": data + frame,
        "something behind": data + b"\0",
        "a cut header": data[:5],
    }


@pytest.mark.parametrize("what", others())
def test_what_is_no_such_image_is_refused(what: str) -> None:
    with pytest.raises(ValueError, match="neither an AV1 picture nor a WebP"):
        decode_image(others()[what], CAMERA)


@each_format
@given(length=st.integers(0, 5000))
def test_truncated_bytes_are_refused_or_an_image_of_the_camera(
    image_format: ImageFormat, length: int
) -> None:
    data = encoded(50, image_format)
    assert len(data) > 1000
    try:
        image = decode_image(data[: length % len(data)], CAMERA)
    except ValueError:
        return
    assert image.shape == (120, 160)


@each_format
def test_half_an_image_is_refused(image_format: ImageFormat) -> None:
    data = encoded(50, image_format)
    with pytest.raises(ValueError, match="a keyframe's image"):
        decode_image(data[: len(data) // 2], CAMERA)


@each_format
@given(data=st.data())
@settings(max_examples=200)
def test_mutated_bytes_are_refused_or_an_image_of_the_camera(
    image_format: ImageFormat, data: st.DataObject
) -> None:
    mutated = bytearray(encoded(30, image_format))
    for _ in range(data.draw(st.integers(1, 6))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        image = decode_image(bytes(mutated), CAMERA)
    except ValueError:
        return
    assert image.shape == (120, 160)


@given(st.binary(max_size=120))
def test_any_bytes_after_a_right_header_do_no_harm(tail: bytes) -> None:
    av1 = encoded(30)
    for start in (encoded(30, "webp")[:30], av1[: 2 + av1[1]] + bytes([0x32, len(tail)])):
        try:
            image = decode_image(start + tail, CAMERA)
        except ValueError:
            continue
        assert image.shape == (120, 160)
