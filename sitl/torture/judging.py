"""What must hold for every payload and blob, whatever it is: read once more, by themselves.

The daemon counts what it refuses by kind. Here the reason is read, nothing but a
``WireError`` may be raised, and what was accepted has to be the only encoding of itself.
"""

from __future__ import annotations

import re
from collections.abc import Callable

from sitl.torture.dice import Dice
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.errors import WireError
from vcl_companion.links.messages import Tunnel
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame, encode_frame
from vcl_companion.wire.map_codec import decode_map, encode_map
from vcl_companion.wire.map_part import decode_map_part, encode_map_part
from vcl_companion.wire.map_update import (
    images_in_update,
    images_missing_in,
    names_of_update,
)
from vcl_companion.wire.pose_messages import PoseRequest, decode_pose_request, encode_pose_request
from vcl_companion.wire.tunnel import decode_payload, encode_payload, is_ours

_LOOKED_AT = 0.3
_VARIABLE = re.compile(
    r"b?'.*'|b?\".*\"|\[.*\]|\([^()]*\)|0x[0-9a-f]+|-?[0-9][0-9.e+x-]*|\b(nan|inf)\b"
)
_MOST_CHARACTERS = 70


class NotTheOnlyEncodingError(Exception):
    """Bytes were accepted that are not what their value is encoded to."""


def payload_outcome(tunnel: Tunnel) -> str:
    """Return what became of a payload, for counting.

    Raises:
        NotTheOnlyEncodingError: it was accepted, and there is another for the same.
    """
    if not is_ours(tunnel.payload_type):
        return "not for us"
    try:
        message = decode_payload(tunnel.payload_type, tunnel.payload)
    except WireError as error:
        return f"refused: {_in_general(error)}"
    _check((tunnel.payload_type, tunnel.payload), encode_payload(message))
    return f"accepted: {type(message).__name__}"


def blob_outcome(kind: BlobKind, blob: bytes, stored: StoredMap | None, dice: Dice) -> str:
    """Return what becomes of a blob, for counting.

    Args:
        kind: what it came as.
        blob: its bytes.
        stored: the map in use, perhaps an update's parent.
        dice: decides whether its images are looked at.

    Raises:
        NotTheOnlyEncodingError: it was accepted, and there is another for the same.
    """
    name = kind.name.lower().replace("_", " ")
    try:
        value = _decoded(kind, blob, stored)
    except WireError as error:
        return f"{name} refused: {_in_general(error)}"
    if dice.chance(_LOOKED_AT):
        return f"{name} accepted: {_images(value)}"
    return f"{name} accepted"


def _decoded(
    kind: BlobKind, blob: bytes, stored: StoredMap | None
) -> FrameAnswer | PoseRequest | LandmarkMap:
    match kind:
        case BlobKind.FRAME_ANSWER | BlobKind.PASSED_FRAME:
            frame = decode_frame(blob, kind)
            _check(blob, encode_frame(frame, kind))
            return frame
        case BlobKind.POSE_REQUEST:
            request = decode_pose_request(blob)
            _check(blob, encode_pose_request(request))
            return request
        case BlobKind.MAP:
            landmark_map = decode_map(blob)
            _check(blob, encode_map(landmark_map))
            return landmark_map
        case BlobKind.MAP_PART:
            whole, data = decode_map_part(blob)
            landmark_map = decode_map(data)
            _check(blob, encode_map_part(whole, encode_map(landmark_map)))
            return landmark_map
        case BlobKind.MAP_UPDATE:
            for read in _READ_OF_UPDATES:
                read(blob)
            return decode_map(_whole_of(blob, stored))


def _whole_of(update: bytes, stored: StoredMap | None) -> bytes:
    """Return the map of an update as the drone that flies on another one reads it."""
    offer = MapOffer.of(BlobKind.MAP_UPDATE, update)
    if stored is None and offer.needs_parent:
        raise WireError("there is no parent")
    parent = stored.index.landmark_map if stored is not None and offer.needs_parent else None
    return offer.whole(parent, offer.images_here({}, stored))


_READ_OF_UPDATES: tuple[Callable[[bytes], object], ...] = (
    names_of_update,
    images_in_update,
    images_missing_in,
)


def _images(value: FrameAnswer | PoseRequest | LandmarkMap) -> str:
    """Decode the images of something that was accepted; a ``ValueError`` refuses one."""
    match value:
        case LandmarkMap():
            images = [(k.image_bytes, k.camera) for k in value.keyframes]
        case PoseRequest():
            images = [(value.frame.image_bytes, value.frame.camera)]
        case FrameAnswer():
            images = [(value.image_bytes, value.camera)]
    try:
        for image_bytes, camera in images:
            decode_image(image_bytes, camera)
    except ValueError as error:
        return _in_general(error)
    return "images decoded"


def _check(came: object, encoded: object) -> None:
    if came != encoded:
        raise NotTheOnlyEncodingError("accepted, and encoded again it is something else")


def _in_general(error: Exception) -> str:
    """Return a reason without the numbers in it: a peer may choose these."""
    return _VARIABLE.sub("#", str(error))[:_MOST_CHARACTERS]
