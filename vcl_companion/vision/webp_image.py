"""Grey images as WebP that is decoded to where it was.

The encoder predicts each block from those above and to the left of it (RFC 6386, section 12),
and what it then leaves out is made of these: all that is in the image comes out too far right
and too far down, by 0.02 to 0.05 px at qualities below 40. The map of a drone that backs off
would tilt by that much with every extension. So it is given the image shifted the other way.
"""

from __future__ import annotations

import struct

import cv2
import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image
from vcl_companion.vision.image_shift import shift_px, shifted

# A smaller drift is none; a larger one comes of noise, or of an image that holds nothing.
_DRIFT_PX, _MOST_DRIFT_PX = 0.002, 0.25
_MOST_CORRECTIONS = 2


def webp_encoded(image: Image, quality: int) -> bytes:
    """Return a grey image as lossy WebP.

    Args:
        image: (H, W) uint8.
        quality: 1 to 100, of libwebp's scale.

    Raises:
        ValueError: it cannot be encoded.
    """
    best = _encoded(image, quality)
    least = drift = _drift(image, best)
    ahead = np.zeros(2)
    for _ in range(_MOST_CORRECTIONS):
        if not _DRIFT_PX < np.abs(drift).max() < _MOST_DRIFT_PX:
            break
        ahead -= drift
        data = _encoded(shifted(image, ahead), quality)
        drift = _drift(image, data)
        if np.abs(drift).max() < np.abs(least).max():
            best, least = data, drift
    return best


def webp_decoded(data: bytes) -> Image | None:
    """Return the (H, W) grey image of a WebP, None if it is none."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if image is None else np.asarray(image, dtype=np.uint8)


def webp_size_px(data: bytes) -> tuple[int, int] | None:
    """Return (width, height) by the header of a plain lossy WebP, the form that is exchanged.

    RIFF container: "RIFF" size "WEBP" "VP8 " size, a 3-byte frame tag, the start
    code 9d 01 2a, then 14 bits each of width and height (RFC 9649, RFC 6386).
    """
    if len(data) < 30 or data[:4] != b"RIFF" or data[8:16] != b"WEBPVP8 ":
        return None
    if data[23:26] != b"\x9d\x01\x2a":
        return None
    width, height = struct.unpack_from("<HH", data, 26)
    return width & 0x3FFF, height & 0x3FFF


def _encoded(image: Image, quality: int) -> bytes:
    options = [cv2.IMWRITE_WEBP_QUALITY, quality]
    ok, buffer = cv2.imencode(".webp", image, options) if image.size else (False, b"")
    if not ok:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded as WebP")
    return bytes(buffer)


def _drift(image: Image, data: bytes) -> Array:
    decoded = webp_decoded(data)
    return np.zeros(2) if decoded is None else shift_px(image, decoded)
