"""What one drone contributes to a map: an image, where it looked, and what is in it."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import cv2
import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Features, Image
from vcl_companion.vision.image_shift import shift_px, shifted

# A smaller drift is none; a larger one comes of noise, or of an image that holds nothing.
_DRIFT_PX, _MOST_DRIFT_PX = 0.002, 0.25
_MOST_CORRECTIONS = 2
_UNREADABLE = "a keyframe's image cannot be decoded"


@dataclass(frozen=True, eq=False)
class DroneView:
    """One image of one drone.

    Attributes:
        drone_id: its system id.
        captured_at_ns: when, on its own clock.
        camera: its intrinsics.
        body_from_cam: its camera's mounting.
        ned_from_body: (3, 3) attitude from its autopilot at that instant, or None.
        image_bytes: the encoded image, as exchanged.
        features: found in that image, one set for each detector the builder uses.
        world_from_body: where the drone's own localization on the map puts it, or None.
        has_heading: whether the attitude's heading is by the north of the others; else only its
            roll and pitch count.
    """

    drone_id: int
    captured_at_ns: int
    camera: Camera
    body_from_cam: Pose
    ned_from_body: Array | None
    image_bytes: bytes
    features: tuple[Features, ...]
    world_from_body: Pose | None = None
    has_heading: bool = True

    @property
    def pixels(self) -> Array:
        """(N, 2) raw pixels of all its features, one detector after the other."""
        return np.concatenate([f.pixels for f in self.features])


def encode_image(image: Image, quality: int, most_bytes: int | None = None) -> bytes:
    """Return a grey image as WebP, the form in which drones exchange it.

    The encoder predicts each block from those above and to the left of it (RFC 6386, section 12),
    and what it then leaves out is made of these: all that is in the image comes out too far right
    and too far down, by 0.02 to 0.05 px at qualities below 40. The map of a drone that backs off
    would tilt by that much with every extension. So it is given the image shifted the other way.

    Args:
        image: (H, W) uint8.
        quality: 1 to 100, at most.
        most_bytes: the quality is lowered until the bytes are no more; what takes more at
            quality 1 stays so.
    """
    data, quality = _affordable(image, quality, most_bytes)
    data = _in_place(image, quality, data)
    while most_bytes is not None and len(data) > most_bytes and quality > 1:
        quality -= 1
        data = _in_place(image, quality, _encoded(image, quality))
    return data


def _affordable(image: Image, quality: int, most_bytes: int | None) -> tuple[bytes, int]:
    """Return an image, as it is, of no more bytes than these, if that can be; and its quality."""
    data = _encoded(image, quality)
    if most_bytes is None or len(data) <= most_bytes:
        return data, quality
    # Six halvings of 1 to 100, each twenty milliseconds; the length rises with the quality.
    fits, too_much = 1, quality
    best = _encoded(image, fits)
    while too_much - fits > 1:
        between = (fits + too_much) // 2
        data = _encoded(image, between)
        if len(data) <= most_bytes:
            fits, best = between, data
        else:
            too_much = between
    return best, fits


def _in_place(image: Image, quality: int, plain: bytes) -> bytes:
    """Return an image encoded so that it is decoded to where it is; ``plain``: as it is."""
    drift = shift_px(image, _pixels(plain))
    best, least, ahead = plain, drift, np.zeros(2)
    for _ in range(_MOST_CORRECTIONS):
        if not _DRIFT_PX < np.abs(drift).max() < _MOST_DRIFT_PX:
            break
        ahead -= drift
        data = _encoded(shifted(image, ahead), quality)
        drift = shift_px(image, _pixels(data))
        if np.abs(drift).max() < np.abs(least).max():
            best, least = data, drift
    return best


def _encoded(image: Image, quality: int) -> bytes:
    ok, buffer = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not ok:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    return bytes(buffer)


def decode_image(image_bytes: bytes, camera: Camera) -> Image:
    """Return the (H, W) uint8 grey image of encoded bytes.

    Everybody, the sender too, uses the decoded image, so that all derive the
    same features from it.

    Raises:
        ValueError: the bytes are no image, or not of the camera's size.
    """
    size_px = _webp_size_px(image_bytes)
    if size_px != (camera.width_px, camera.height_px):
        # Told before decoding: a few hostile bytes may claim gigabytes of pixels.
        raise ValueError(
            f"a keyframe's image is no WebP of {camera.width_px}x{camera.height_px}: {size_px}"
        )
    image = _pixels(image_bytes)
    if image.shape != (camera.height_px, camera.width_px):
        raise ValueError(_UNREADABLE)
    return image


def _pixels(image_bytes: bytes) -> Image:
    image = cv2.imdecode(np.frombuffer(image_bytes, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(_UNREADABLE)
    return np.asarray(image, dtype=np.uint8)


def _webp_size_px(image_bytes: bytes) -> tuple[int, int] | None:
    """Return (width, height) by the header of a plain lossy WebP, the form that is exchanged.

    RIFF container: "RIFF" size "WEBP" "VP8 " size, a 3-byte frame tag, the start
    code 9d 01 2a, then 14 bits each of width and height (RFC 9649, RFC 6386).
    """
    if len(image_bytes) < 30 or image_bytes[:4] != b"RIFF" or image_bytes[8:16] != b"WEBPVP8 ":
        return None
    if image_bytes[23:26] != b"\x9d\x01\x2a":
        return None
    width, height = struct.unpack_from("<HH", image_bytes, 26)
    return width & 0x3FFF, height & 0x3FFF
