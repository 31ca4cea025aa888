"""The part of a map that is sent first: it names the whole, and is a map in itself."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.wire.golden import assert_golden
from tests.wire.samples import small_map
from vcl_companion.errors import WireError
from vcl_companion.wire.header import BlobKind, VersionMismatchError, encode_header
from vcl_companion.wire.map_codec import encode_map
from vcl_companion.wire.map_part import decode_map_part, encode_map_part

PART = encode_map(small_map())


def test_golden_bytes() -> None:
    blob = encode_map_part(b"of these", PART)
    assert_golden("map_part", blob)
    assert decode_map_part(blob) == (b"of these", PART)


def test_what_is_no_part_is_refused() -> None:
    for blob in (b"", PART, encode_header(BlobKind.MAP_PART) + b"7 bytes"):
        with pytest.raises(WireError):
            decode_map_part(blob)
    with pytest.raises(VersionMismatchError):
        decode_map_part(b"\xff" + encode_map_part(b"of these", PART)[1:])


@given(st.binary(max_size=64))
def test_any_bytes_are_a_part_or_a_wire_error(body: bytes) -> None:
    blob = encode_header(BlobKind.MAP_PART) + body
    try:
        whole, part = decode_map_part(blob)
    except WireError:
        return
    assert encode_map_part(whole, part) == blob
