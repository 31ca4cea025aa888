"""Signatures: small, the same for the same frame, alike for one place, unlike for two."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.vision.photographs import folder_of
from vcl_companion.recording.images import load_image
from vcl_companion.recording.recording import read_recording
from vcl_companion.vision.features import Image
from vcl_companion.vision.signature import (
    POINTS,
    SIGNATURE_BYTES,
    chance,
    is_signature,
    likeness,
    log_likelihood_ratios,
    signature_of,
    words_of,
)


def textured(rng: np.random.Generator, width: int = 640, height: int = 480) -> Image:
    """Blobs of all sizes."""
    out = np.zeros((height, width))
    for size in (4, 8, 16, 32):
        coarse = rng.uniform(0.0, 1.0, (height // size + 1, width // size + 1))
        out += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(out * 64, 0, 255), dtype=np.uint8)


def warped(image: Image, scale: float, shear: float) -> Image:
    height, width = image.shape
    matrix = np.array([[scale * (1 - shear), shear * 0.3, 9.0], [0.0, scale, -5.0]])
    size = (width, height)
    return np.asarray(cv2.warpAffine(image, matrix, size, borderMode=cv2.BORDER_REFLECT), np.uint8)


def common(a: bytes, b: bytes) -> int:
    return int(likeness(words_of(a), words_of(b)[None])[0])


@pytest.mark.parametrize("size", [(640, 480), (1280, 960), (320, 240), (480, 640)])
def test_a_frame_has_one_signature_and_nothing_has_none(size: tuple[int, int]) -> None:
    image = textured(np.random.default_rng(1), *size)
    signature = signature_of(image)
    assert len(signature) == SIGNATURE_BYTES
    assert is_signature(signature)
    assert signature == signature_of(image.copy())
    assert common(signature, signature) == POINTS
    assert signature_of(np.full(image.shape, 90, np.uint8)) == b""


@pytest.mark.parametrize("shape", [(1, 1), (1, 900), (900, 1), (33, 33), (2, 3000)])
def test_images_of_any_shape_have_a_signature_or_none(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)
    assert signature_of(noise) == b"" or is_signature(signature_of(noise))


def test_it_stays_alike_from_aside_and_from_nearer() -> None:
    rng = np.random.default_rng(2)
    frames = [textured(rng) for _ in range(12)]
    signatures = [signature_of(frame) for frame in frames]
    near = [
        common(s, signature_of(warped(f, 1.1, 0.05)))
        for s, f in zip(signatures, frames, strict=True)
    ]
    far = [
        common(s, signature_of(warped(f, 1.4, 0.1)))
        for s, f in zip(signatures, frames, strict=True)
    ]
    others = [common(a, b) for i, a in enumerate(signatures) for b in signatures[:i]]
    assert np.mean(near) > 5 > np.mean(far) > 3 * np.mean(others)
    assert np.mean(others) < 0.5


def test_random_bits_are_alike_as_often_as_the_binomial_has_it() -> None:
    words = np.random.default_rng(3).integers(0, 1 << 24, (60_000, POINTS)).astype(np.int32)
    n_common = likeness(words[0], words[1:])
    for n in (1, 2):
        expected = chance(n) * len(n_common)
        assert abs(np.sum(n_common >= n) - expected) < 4 * np.sqrt(expected)
    assert chance(0) == pytest.approx(1.0)
    assert all(chance(n + 1) < 0.1 * chance(n) for n in range(POINTS))


def test_points_that_are_not_there_are_like_nothing() -> None:
    words = words_of(bytes(24))
    assert likeness(words, np.stack([words_of(bytes(48)), words]))[0] == 8
    none = np.full((1, POINTS), -1, np.int32)
    assert likeness(none[0], none)[0] == 0
    assert log_likelihood_ratios(words, none)[0] < 0 < log_likelihood_ratios(words, words[None])[0]


@given(st.binary(max_size=60))
def test_any_bytes_are_a_signature_by_their_length_alone(data: bytes) -> None:
    assert is_signature(data) == (len(data) in range(24, 49, 3))
    if is_signature(data):
        assert common(data, data) == len(data) // 3


@pytest.mark.parametrize("name", ["demo", "fountain-P11", "Herz-Jesus-P8", "yard"])
def test_drones_side_by_side_see_one_place(name: str) -> None:
    ours, theirs = signatures(name)
    ratios = [log_likelihood_ratios(a, b[None])[0] for a, b in zip(ours, theirs, strict=False)]
    assert np.mean(ratios) > 0.8


def test_photographs_of_different_places_are_told_apart() -> None:
    fountain, church = signatures("fountain-P11")[0], signatures("Herz-Jesus-P8")[0]
    ratios = [log_likelihood_ratios(words, fountain) for words in church]
    assert np.mean(ratios) < -0.3
    assert np.max(ratios) < 1.0


def signatures(name: str) -> list[NDArray[np.int32]]:
    """Return (N, 16) points of the first frames of each of two drones, as ``words_of``."""
    return [
        np.array(
            [
                words_of(signature_of(load_image(frame.path, drone.sensor.camera)))
                for frame in drone.frames[:6]
            ]
        )
        for drone in read_recording(folder_of(name)).drones[:2]
    ]
