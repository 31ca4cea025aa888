"""A part of a map, for one who has none and is on a link where the whole takes long.

A part is a map in itself, in the same frame, of the newest keyframes. It is named as a part, so
that who flies on it hands it to nobody and does not say that it has the swarm's map. What the
whole has beyond it comes as an update (``map_update``).
"""

from __future__ import annotations

from vcl_companion.errors import WireError
from vcl_companion.wire.header import HEADER_BYTES, BlobKind, decode_header, encode_header
from vcl_companion.wire.map_codec import REVISION_BYTES
from vcl_companion.wire.reader import Reader

# | 2  | 8 bytes | revision of the whole map            |
# | 10 | rest    | the part, a map, from its offset 2 on |


def encode_map_part(whole: bytes, part: bytes) -> bytes:
    """Return the bytes of a part.

    Args:
        whole: revision of the map that it is of.
        part: the part, an encoded map.
    """
    return encode_header(BlobKind.MAP_PART) + whole + part[HEADER_BYTES:]


def decode_map_part(blob: bytes) -> tuple[bytes, bytes]:
    """Return the revision of the whole map, and the part as an encoded map, which is not read.

    Raises:
        WireError: the bytes do not begin like one.
    """
    kind = decode_header(blob)
    if kind != BlobKind.MAP_PART:
        raise WireError(f"not a part of a map: blob kind {kind}")
    reader = Reader(blob, "map part", HEADER_BYTES)
    whole = reader.take(REVISION_BYTES)
    return whole, encode_header(BlobKind.MAP) + reader.rest()
