"""A map for one who has its parent: the images that are known there stay at home.

Images are nearly all of a map. An update keeps most of its parent's, and the others
may have been sent ahead, while the map was being built. What comes out of decoding is
the whole map's bytes, proven by its revision.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Mapping
from dataclasses import replace

from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.wire.header import HEADER_BYTES, BlobKind, decode_header, encode_header
from vcl_companion.wire.map_codec import (
    REVISION_BYTES,
    decode_map,
    encode_map,
    parent_of,
    revision_of,
)
from vcl_companion.wire.reader import Reader

# | 2  | 8 bytes | revision of the whole map                                        |
# | 10 | rest    | the whole map's bytes from its offset 2 on, but an image of two  |
# |    |         | bytes is a u16: the parent's keyframe whose image it is; one of  |
# |    |         | eight bytes names an image that was sent ahead                   |
_PLACE = struct.Struct("<H")
_NAME_BYTES = 8


def name_of_image(image_bytes: bytes) -> bytes:
    """Return the 8 bytes that name an encoded image: the first of its SHA-256."""
    return hashlib.sha256(image_bytes).digest()[:_NAME_BYTES]


def encode_map_update(data: bytes, parent: LandmarkMap) -> bytes:
    """Return the bytes of a map without the images of its parent.

    Args:
        data: the whole map, encoded.
        parent: the revision that it names as its parent, decoded.

    Raises:
        WireError: ``data`` is no map.
        ValueError: it has an image that is taken for a reference.
    """
    whole = decode_map(data)
    places = {keyframe.image_bytes: k for k, keyframe in enumerate(parent.keyframes)}
    keyframes = []
    for keyframe in whole.keyframes:
        place = places.get(keyframe.image_bytes)
        if place is None and _is_reference(keyframe):
            raise ValueError(f"an image of {len(keyframe.image_bytes)} bytes is none")
        image = keyframe.image_bytes if place is None else _PLACE.pack(place)
        keyframes.append(replace(keyframe, image_bytes=image))
    bare = encode_map(replace(whole, keyframes=tuple(keyframes)))
    return encode_header(BlobKind.MAP_UPDATE) + revision_of(data) + bare[HEADER_BYTES:]


def images_in_update(update: bytes) -> frozenset[bytes]:
    """Return the names of the images that an encoded update carries.

    Raises:
        WireError: the bytes are no update.
    """
    _, bare = _split(update)
    keyframes = decode_map(bare).keyframes
    return frozenset(name_of_image(k.image_bytes) for k in keyframes if not _is_reference(k))


def without_images(update: bytes, held: Collection[bytes]) -> bytes:
    """Return an encoded update for one who holds images by these names as well.

    Raises:
        WireError: the bytes are no update.
    """
    revision, bare = _split(update)
    whole = decode_map(bare)
    keyframes = []
    for keyframe in whole.keyframes:
        name = name_of_image(keyframe.image_bytes)
        stays = not _is_reference(keyframe) and name in held
        keyframes.append(replace(keyframe, image_bytes=name) if stays else keyframe)
    bare = encode_map(replace(whole, keyframes=tuple(keyframes)))
    return encode_header(BlobKind.MAP_UPDATE) + revision + bare[HEADER_BYTES:]


def names_of_update(blob: bytes) -> tuple[bytes, bytes]:
    """Return revision and parent of an encoded update, the rest unseen.

    Raises:
        WireError: the bytes do not begin like one.
    """
    revision, bare = _split(blob)
    return revision, parent_of(bare)


def decode_map_update(blob: bytes, parent: LandmarkMap, held: Mapping[bytes, bytes]) -> bytes:
    """Return the whole map's bytes.

    Args:
        blob: what came.
        parent: the map that it was made from, decoded.
        held: images that were sent ahead, by their names.

    Raises:
        WireError: the bytes are no update, or not one of this parent, or need an
            image that is not held.
    """
    revision, bare = _split(blob)
    update = decode_map(bare)
    keyframes = tuple(_with_image(keyframe, parent, held) for keyframe in update.keyframes)
    try:
        data = encode_map(replace(update, keyframes=keyframes))
    except ValueError as error:  # the images make it longer than peers accept
        raise WireError(f"map update: {error}") from None
    if revision_of(data) != revision:
        raise WireError("map update: with our images it is another map")
    return data


def _split(blob: bytes) -> tuple[bytes, bytes]:
    """Return the revision and the bytes that remain, as those of a map."""
    kind = decode_header(blob)
    if kind != BlobKind.MAP_UPDATE:
        raise WireError(f"not a map update: blob kind {kind}")
    revision = Reader(blob, "map update", HEADER_BYTES).take(REVISION_BYTES)
    return revision, encode_header(BlobKind.MAP) + blob[HEADER_BYTES + REVISION_BYTES :]


def _is_reference(keyframe: Keyframe) -> bool:
    return len(keyframe.image_bytes) in (_PLACE.size, _NAME_BYTES)


def _with_image(keyframe: Keyframe, parent: LandmarkMap, held: Mapping[bytes, bytes]) -> Keyframe:
    if not _is_reference(keyframe):
        return keyframe
    if len(keyframe.image_bytes) == _NAME_BYTES:
        image = held.get(keyframe.image_bytes)
        if image is None:
            raise WireError("map update: an image that was sent ahead is not here")
        return replace(keyframe, image_bytes=image)
    (place,) = _PLACE.unpack(keyframe.image_bytes)
    if place >= len(parent.keyframes):
        raise WireError(f"map update: there is no keyframe {place} in its parent")
    return replace(keyframe, image_bytes=parent.keyframes[place].image_bytes)
