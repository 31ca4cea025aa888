"""A map for one who has its parent, or none of them: what is known stays there.

Images are nearly all of a map. An update keeps most of its parent's, and the others
may have been sent ahead, while the map was being built, or be in another map that its receiver
flies on; of the landmarks it tells what has changed (``map_delta``). What comes out of decoding
is the whole map's bytes, proven by its revision.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.wire.header import HEADER_BYTES, BlobKind, decode_header, encode_header
from vcl_companion.wire.map_codec import (
    REVISION_BYTES,
    MapHead,
    decode_map,
    encode_head,
    encode_map,
    parent_of,
    revision_of,
    take_head,
)
from vcl_companion.wire.map_delta import encode_changes, n_of_parent, take_changes
from vcl_companion.wire.reader import Reader

# | 2  | 8 bytes | revision of the whole map                                        |
# | 10 | rest    | the whole map's head from its offset 2 on, but an image of two   |
# |    |         | bytes is a u16: the parent's keyframe whose image it is; one of  |
# |    |         | eight bytes names an image that was sent ahead; then map_delta   |
_PLACE = struct.Struct("<H")
_NAME_BYTES = 8
# What a first map was made from.
_NO_MAP = LandmarkMap((), np.zeros((0, 3)), np.zeros((0, 0, 2)), 1.0, (), (), b"")


def name_of_image(image_bytes: bytes) -> bytes:
    """Return the 8 bytes that name an encoded image: the first of its SHA-256."""
    return hashlib.sha256(image_bytes).digest()[:_NAME_BYTES]


def images_by_name(keyframes: Iterable[Keyframe]) -> dict[bytes, bytes]:
    """Return keyframes' encoded images by their names."""
    return {name_of_image(keyframe.image_bytes): keyframe.image_bytes for keyframe in keyframes}


def encode_map_update(
    data: bytes, parent: LandmarkMap | None, whole: LandmarkMap | None = None
) -> bytes:
    """Return the bytes of a map without what its parent has.

    Args:
        data: the whole map, encoded.
        parent: the revision that it names as its parent, decoded; None for one who has not got
            that, and for a first map.
        whole: the map, decoded; None: that is done here.

    Raises:
        WireError: ``data`` is no map.
        ValueError: it has an image that is taken for a reference.
    """
    whole, parent = whole or decode_map(data), parent or _NO_MAP
    place_of = {keyframe.image_bytes: k for k, keyframe in enumerate(parent.keyframes)}
    places = [place_of.get(keyframe.image_bytes) for keyframe in whole.keyframes]
    keyframes = []
    for keyframe, place in zip(whole.keyframes, places, strict=True):
        if place is None and _is_reference(keyframe):
            raise ValueError(f"an image of {len(keyframe.image_bytes)} bytes is none")
        image = keyframe.image_bytes if place is None else _PLACE.pack(place)
        keyframes.append(replace(keyframe, image_bytes=image))
    head = encode_head(replace(MapHead.of(whole), keyframes=tuple(keyframes)))
    return _joined(revision_of(data), head + encode_changes(whole, parent, places))


def images_in_map(data: bytes) -> frozenset[bytes]:
    """Return the names of the images of an encoded whole map.

    Raises:
        WireError: the bytes are no map.
    """
    return frozenset(images_by_name(_head_of(Reader(data, "map", HEADER_BYTES)).keyframes))


def images_in_update(update: bytes) -> frozenset[bytes]:
    """Return the names of the images that an encoded update carries.

    Raises:
        WireError: the bytes are no update.
    """
    _, reader = _split(update)
    keyframes = _head_of(reader).keyframes
    return frozenset(images_by_name(k for k in keyframes if not _is_reference(k)))


def images_missing_in(update: bytes) -> frozenset[bytes]:
    """Return the names of the images that an encoded update takes its receiver to hold.

    Raises:
        WireError: the bytes are no update.
    """
    _, reader = _split(update)
    return frozenset(k.image_bytes for k in _head_of(reader).keyframes if _is_named(k))


def needs_parent(update: bytes) -> bool:
    """Return whether an encoded update takes its receiver to have its parent.

    Raises:
        WireError: the bytes are no update.
    """
    _, reader = _split(update)
    _head_of(reader)
    return n_of_parent(reader) > 0


def without_images(update: bytes, held: Collection[bytes]) -> bytes:
    """Return an encoded update for one who holds images by these names as well.

    Raises:
        WireError: the bytes are no update.
    """
    revision, reader = _split(update)
    head = _head_of(reader)
    keyframes = []
    for keyframe in head.keyframes:
        name = name_of_image(keyframe.image_bytes)
        stays = not _is_reference(keyframe) and name in held
        keyframes.append(replace(keyframe, image_bytes=name) if stays else keyframe)
    head = replace(head, keyframes=tuple(keyframes))
    return _joined(revision, encode_head(head) + reader.rest())


def with_images(update: bytes, held: Mapping[bytes, bytes]) -> bytes:
    """Return an encoded update for one who holds no images, the inverse of ``without_images``.

    Args:
        update: what came.
        held: images by their names.

    Raises:
        WireError: the bytes are no update, or need an image that is not held.
    """
    revision, reader = _split(update)
    head = _head_of(reader)
    keyframes = tuple(
        replace(k, image_bytes=_sent_ahead(k, held)) if _is_named(k) else k for k in head.keyframes
    )
    try:
        data = encode_head(replace(head, keyframes=keyframes))
    except ValueError as error:  # the images may make it longer than peers accept
        raise WireError(f"map update: {error}") from None
    return _joined(revision, data + reader.rest())


def names_of_update(blob: bytes) -> tuple[bytes, bytes]:
    """Return revision and parent of an encoded update, the rest unseen.

    Raises:
        WireError: the bytes do not begin like one.
    """
    revision, reader = _split(blob)
    return revision, parent_of(encode_header(BlobKind.MAP) + reader.rest())


def decode_map_update(
    blob: bytes, parent: LandmarkMap | None, held: Mapping[bytes, bytes]
) -> bytes:
    """Return the whole map's bytes.

    Args:
        blob: what came.
        parent: the map that it was made from, decoded; None where it does not need that.
        held: images that were sent ahead, by their names.

    Raises:
        WireError: the bytes are no update, or not one of this parent, or need an
            image that is not held.
    """
    revision, reader = _split(blob)
    head, parent = _head_of(reader), parent or _NO_MAP
    places = [_place(keyframe, parent) for keyframe in head.keyframes]
    keyframes = tuple(
        replace(k, image_bytes=_image(k, place, parent, held))
        for k, place in zip(head.keyframes, places, strict=True)
    )
    try:
        whole = take_changes(reader, replace(head, keyframes=keyframes), parent, places)
        data = encode_map(whole)
    except ValueError as error:  # the images may make it longer than peers accept
        raise WireError(f"map update: {error}") from None
    if revision_of(data) != revision:
        raise WireError("map update: with what we have it is another map")
    return data


def _joined(revision: bytes, rest: bytes) -> bytes:
    return encode_header(BlobKind.MAP_UPDATE) + revision + rest


def _split(blob: bytes) -> tuple[bytes, Reader]:
    """Return the revision, and what reads the rest."""
    kind = decode_header(blob)
    if kind != BlobKind.MAP_UPDATE:
        raise WireError(f"not a map update: blob kind {kind}")
    reader = Reader(blob, "map update", HEADER_BYTES)
    return reader.take(REVISION_BYTES), reader


def _head_of(reader: Reader) -> MapHead:
    try:
        return take_head(reader)
    except ValueError as error:
        raise WireError(f"map update: {error}") from None


def _is_reference(keyframe: Keyframe) -> bool:
    return len(keyframe.image_bytes) in (_PLACE.size, _NAME_BYTES)


def _is_named(keyframe: Keyframe) -> bool:
    return len(keyframe.image_bytes) == _NAME_BYTES


def _place(keyframe: Keyframe, parent: LandmarkMap) -> int | None:
    """Return which of the parent's keyframes it is; None for a new one."""
    if len(keyframe.image_bytes) != _PLACE.size:
        return None
    place = int(_PLACE.unpack(keyframe.image_bytes)[0])
    if place >= len(parent.keyframes):
        raise WireError(f"map update: there is no keyframe {place} in its parent")
    return place


def _image(
    keyframe: Keyframe, place: int | None, parent: LandmarkMap, held: Mapping[bytes, bytes]
) -> bytes:
    if place is not None:
        return parent.keyframes[place].image_bytes
    return _sent_ahead(keyframe, held) if _is_named(keyframe) else keyframe.image_bytes


def _sent_ahead(keyframe: Keyframe, held: Mapping[bytes, bytes]) -> bytes:
    """Return the image that a keyframe names."""
    image = held.get(keyframe.image_bytes)
    if image is None:
        raise WireError("map update: an image that was sent ahead is not here")
    return image
