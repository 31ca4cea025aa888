"""The images of keyframes as drones exchange them: AV1 pictures, or WebP.

Everybody, the sender too, uses the decoded image, so that all derive the same features from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, get_args

from vcl_companion.geometry.camera import Camera
from vcl_companion.vision.av1_image import av1_decoded, av1_encoded, av1_size_px
from vcl_companion.vision.features import Image
from vcl_companion.vision.webp_image import webp_decoded, webp_encoded, webp_size_px

ImageFormat = Literal["av1", "webp"]
IMAGE_FORMATS: tuple[ImageFormat, ...] = get_args(ImageFormat)


@dataclass(frozen=True)
class _Codec:
    encoded: Callable[[Image, int], bytes]
    decoded: Callable[[bytes], Image | None]
    size_px: Callable[[bytes], tuple[int, int] | None]


_CODECS: Mapping[ImageFormat, _Codec] = MappingProxyType(
    {
        "av1": _Codec(av1_encoded, av1_decoded, av1_size_px),
        "webp": _Codec(webp_encoded, webp_decoded, webp_size_px),
    }
)


def encode_image(
    image: Image, quality: int, most_bytes: int | None = None, image_format: ImageFormat = "av1"
) -> bytes:
    """Return a grey image as drones exchange it.

    Args:
        image: (H, W) uint8.
        quality: 1 to 100, at most, of the format's own scale.
        most_bytes: the quality is lowered until the bytes are no more; what takes more at
            quality 1 stays so.
        image_format: how; whoever gets it sees by its bytes.

    Raises:
        ValueError: it cannot be encoded.
    """
    encoded = _CODECS[image_format].encoded
    data = encoded(image, quality)
    if most_bytes is None or len(data) <= most_bytes:
        return data
    # Six halvings of 1 to 100; the length rises with the quality.
    fits, too_much = 1, quality
    best = encoded(image, fits)
    while too_much - fits > 1:
        between = (fits + too_much) // 2
        data = encoded(image, between)
        if len(data) <= most_bytes:
            fits, best = between, data
        else:
            too_much = between
    return best


def decode_image(image_bytes: bytes, camera: Camera) -> Image:
    """Return the (H, W) uint8 grey image of encoded bytes.

    Raises:
        ValueError: the bytes are no image, or not of the camera's size.
    """
    size_px = (camera.width_px, camera.height_px)
    for codec in _CODECS.values():
        claimed_px = codec.size_px(image_bytes)
        if claimed_px is None:
            continue
        if claimed_px != size_px:
            # Told before decoding: a few hostile bytes may claim gigabytes of pixels.
            raise ValueError(
                f"a keyframe's image is not of {size_px[0]}x{size_px[1]} pixels: {claimed_px}"
            )
        image = codec.decoded(image_bytes)
        if image is None or image.shape != (camera.height_px, camera.width_px):
            raise ValueError("a keyframe's image cannot be decoded")
        return image
    raise ValueError("a keyframe's image is neither an AV1 picture nor a WebP")
