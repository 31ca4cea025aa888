import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.folders import CAMERA, grey_image
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.recording.images import check_image, image_size_px, load_image


@given(
    st.integers(1, 300),
    st.integers(1, 300),
    st.sampled_from([".png", ".jpg"]),
    st.booleans(),
    st.booleans(),
)
def test_the_header_gives_the_decoders_size(
    tmp_path_factory: pytest.TempPathFactory,
    width: int,
    height: int,
    suffix: str,
    colour: bool,
    progressive: bool,
) -> None:
    path = tmp_path_factory.mktemp("images") / f"image{suffix}"
    image = np.zeros((height, width, 3) if colour else (height, width), dtype=np.uint8)
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)] if suffix == ".jpg" else []
    assert cv2.imwrite(str(path), image, flags)
    assert image_size_px(path) == (width, height)


def test_png_decodes_exactly_and_colour_becomes_grey(tmp_path: Path) -> None:
    image = grey_image(np.random.default_rng(1))
    cv2.imwrite(str(tmp_path / "grey.png"), image)
    np.testing.assert_array_equal(load_image(tmp_path / "grey.png", CAMERA), image)
    cv2.imwrite(str(tmp_path / "colour.png"), cv2.merge([image, image, image]))
    colour = load_image(tmp_path / "colour.png", CAMERA)
    assert colour.shape == image.shape
    assert np.abs(colour.astype(int) - image).max() <= 1


def test_orientation_tags_do_not_turn_the_image(tmp_path: Path) -> None:
    path = tmp_path / "tagged.jpg"
    cv2.imwrite(str(path), grey_image(np.random.default_rng(2)))
    content = path.read_bytes()
    # EXIF with one entry: orientation 6, "turn by 90 degrees".
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\0\0" + tiff
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    path.write_bytes(content[:2] + segment + content[2:])
    turned = cv2.imread(str(path))
    assert turned is not None
    assert turned.shape[:2] == (CAMERA.width_px, CAMERA.height_px)
    assert load_image(path, CAMERA).shape == (CAMERA.height_px, CAMERA.width_px)


def test_a_wrong_size_names_both(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), grey_image(np.random.default_rng(3)))
    with pytest.raises(RecordingError, match=r"is 48x32, its calibration says 32x48$"):
        load_image(tmp_path / "a.jpg", Camera(32, 48, 40.0, 40.0, 15.5, 23.5))


def test_a_damaged_body_behind_a_good_header(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), grey_image(np.random.default_rng(4)))
    content = bytearray(path.read_bytes())
    content[40:-20] = bytes(len(content) - 60)
    path.write_bytes(bytes(content))
    check_image(path, CAMERA)  # a header cannot tell
    with pytest.raises(RecordingError, match=r"a\.png cannot be decoded; copy it again$"):
        load_image(path, CAMERA)


@given(st.sampled_from([".png", ".jpg"]), st.floats(0.0, 0.999))
def test_a_cut_file_is_refused_wherever_it_was_cut(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, share: float
) -> None:
    path = tmp_path_factory.mktemp("cut") / f"a{suffix}"
    cv2.imwrite(str(path), grey_image(np.random.default_rng(5)))
    content = path.read_bytes()
    path.write_bytes(content[: int(share * (len(content) - 10))])
    with pytest.raises(RecordingError):
        check_image(path, CAMERA)


@given(st.binary(max_size=64), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]))
def test_any_bytes_are_an_image_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, magic: bytes
) -> None:
    path = tmp_path_factory.mktemp("bytes") / "a.jpg"
    path.write_bytes(magic + content)
    with pytest.raises(RecordingError) as caught:
        load_image(path, CAMERA)
    assert "\n" not in str(caught.value)
