"""Images of a recording: checked by their headers when it is opened, decoded when played."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera

_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_JPEG_MAGIC = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_PNG_END = b"IEND"
# Frame headers (ITU T.81 table B.1) are C0..CF but for Huffman tables, extensions, arithmetic.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Some cameras pad behind the end marker; a file that was cut has none at all.
_TAIL_BYTES = 1024
MAX_IMAGE_BYTES = 16 * 1024 * 1024
"""Of an encoded one: what is longer is no frame of a camera."""
# EXIF must not turn the image: the calibration is of the sensor, not of the horizon.
_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


def check_image(path: Path, camera: Camera) -> None:
    """Check without decoding that a file is a whole JPEG or PNG of the camera's size.

    Raises:
        RecordingError: it is not; one line that names the file.
    """
    _check_size(path, image_size_px(path), camera)


def image_size_px(path: Path) -> tuple[int, int]:
    """Return (width, height) of a whole JPEG or PNG file from its header.

    Raises:
        RecordingError: it is missing, something else, or cut off.
    """
    try:
        with path.open("rb") as file:
            end = _PNG_END if file.read(1) == _PNG_MAGIC[:1] else _JPEG_END
            file.seek(0)
            size = _size_px(file)
            file.seek(0, 2)
            n_bytes = file.tell()
            file.seek(max(0, n_bytes - _TAIL_BYTES))
            whole = end in file.read()
    except FileNotFoundError:
        raise RecordingError(f"image {path} is missing; restore it or remove the row") from None
    except OSError as error:
        raise RecordingError(f"image {path} cannot be read ({error.strerror})") from None
    except ValueError:
        raise RecordingError(f"image name {path.name[:80]!r} is not a file name") from None
    if size is None:
        raise RecordingError(f"image {path} is not a JPEG or PNG file")
    if n_bytes > MAX_IMAGE_BYTES:
        raise RecordingError(f"image {path} has more than {MAX_IMAGE_BYTES >> 20} MiB")
    if not whole:
        raise RecordingError(f"image {path} is cut off at its end; copy it again")
    return size


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image as the camera's grey levels.

    Returns:
        (H, W) uint8.

    Raises:
        RecordingError: it is missing, damaged, or not of the camera's size.
    """
    check_image(path, camera)
    try:
        encoded = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise RecordingError(f"image {path} cannot be read ({error.strerror})") from None
    try:
        image = cv2.imdecode(encoded, _GREY)
    except cv2.error:
        image = None
    if image is None:
        raise RecordingError(f"image {path} cannot be decoded; copy it again")
    _check_size(path, (image.shape[1], image.shape[0]), camera)
    return np.asarray(image, dtype=np.uint8)


def _check_size(path: Path, size_px: tuple[int, int], camera: Camera) -> None:
    if size_px != (camera.width_px, camera.height_px):
        raise RecordingError(
            f"image {path} is {size_px[0]}x{size_px[1]}, its calibration says "
            f"{camera.width_px}x{camera.height_px}"
        )


def _size_px(file: BinaryIO) -> tuple[int, int] | None:
    """Return (width, height) from a PNG or JPEG header; None when it is neither."""
    head = file.read(24)
    if head.startswith(_PNG_MAGIC) and head[12:16] == b"IHDR" and len(head) == 24:
        width, height = struct.unpack(">II", head[16:24])
        return width, height
    if not head.startswith(_JPEG_MAGIC):
        return None
    file.seek(2)
    while True:
        marker = file.read(2)
        while marker == b"\xff\xff":  # fill bytes before a marker
            marker = b"\xff" + file.read(1)
        if len(marker) < 2 or marker[0] != 0xFF:
            return None
        segment = file.read(2)
        if len(segment) < 2:
            return None
        if marker[1] in _JPEG_FRAMES:
            frame = file.read(5)
            if len(frame) < 5:
                return None
            height, width = struct.unpack(">HH", frame[1:])
            return width, height
        (n_bytes,) = struct.unpack(">H", segment)
        if n_bytes < 2:
            return None
        file.seek(n_bytes - 2, 1)
