"""A map for one who has its parent: the images that are known there stay at home.

Images are nearly all of a map, and an update keeps most of its parent's. What
comes out of decoding is the whole map's bytes, proven by its revision.
"""

from __future__ import annotations

import struct
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
# |    |         | bytes is a u16: the parent's keyframe whose image it is          |
_PLACE = struct.Struct("<H")


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
        if place is None and len(keyframe.image_bytes) == _PLACE.size:
            raise ValueError("an image of two bytes is none")
        image = keyframe.image_bytes if place is None else _PLACE.pack(place)
        keyframes.append(replace(keyframe, image_bytes=image))
    bare = encode_map(replace(whole, keyframes=tuple(keyframes)))
    return encode_header(BlobKind.MAP_UPDATE) + revision_of(data) + bare[HEADER_BYTES:]


def names_of_update(blob: bytes) -> tuple[bytes, bytes]:
    """Return revision and parent of an encoded update, the rest unseen.

    Raises:
        WireError: the bytes do not begin like one.
    """
    revision, bare = _split(blob)
    return revision, parent_of(bare)


def decode_map_update(blob: bytes, parent: LandmarkMap) -> bytes:
    """Return the whole map's bytes.

    Args:
        blob: what came.
        parent: the map that it was made from, decoded.

    Raises:
        WireError: the bytes are no update, or not one of this parent.
    """
    revision, bare = _split(blob)
    update = decode_map(bare)
    keyframes = tuple(_with_image(keyframe, parent) for keyframe in update.keyframes)
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


def _with_image(keyframe: Keyframe, parent: LandmarkMap) -> Keyframe:
    if len(keyframe.image_bytes) != _PLACE.size:
        return keyframe
    (place,) = _PLACE.unpack(keyframe.image_bytes)
    if place >= len(parent.keyframes):
        raise WireError(f"map update: there is no keyframe {place} in its parent")
    return replace(keyframe, image_bytes=parent.keyframes[place].image_bytes)
