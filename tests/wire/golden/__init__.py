"""Bytes that must not change within a protocol version, as hexadecimal text files.

A change here is a change of the protocol: raise ``PROTOCOL_VERSION`` and write
the files anew by deleting them and running the tests once.
"""

from __future__ import annotations

from pathlib import Path

import pytest

_FOLDER = Path(__file__).parent


def assert_golden(name: str, data: bytes) -> None:
    """Compare with the file of that name; a missing file is written, and the test fails."""
    path = _FOLDER / f"{name}.hex"
    if not path.exists():
        text = data.hex(" ")
        lines = [text[at : at + 96].rstrip() for at in range(0, len(text), 96)]
        path.write_text("\n".join(lines) + "\n")
        pytest.fail(f"{path.name} was missing and is written now: look at it and run again")
    assert data == bytes.fromhex(path.read_text())


def golden(name: str) -> bytes:
    """Return the bytes of the file of that name."""
    return bytes.fromhex((_FOLDER / f"{name}.hex").read_text())
