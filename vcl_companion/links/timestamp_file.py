"""What signing remembers from one run to the next: how late it is, and what was heard last.

The file names an instant that is still to come, and names a later one before that has come
(``kept_signing.py``). So a drone that lost power starts above all that it has ever signed,
whatever its clock says, and nobody takes its new frames for old ones. What it has heard is
written with it: frames that were recorded before the cut are not taken again after it, but
for those of the last seconds.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from vcl_companion.errors import ConfigError, reason_of
from vcl_companion.links.signing import Stream

_log = logging.getLogger(__name__)

_MAX_FILE_BYTES = 1 << 17
_MAX_TIMESTAMP = 2**48


@dataclass(frozen=True)
class Timestamps:
    """What is kept.

    Attributes:
        reserved: nothing was signed beyond this timestamp; 0: nothing is known.
        streams: the latest timestamp that was taken from each stream.
    """

    reserved: int = 0
    streams: Mapping[Stream, int] = field(default_factory=dict)


class TimestampFile:
    """Reads and writes it; writing takes as long as the disk does, any thread may.

    Args:
        path: the file; its folder is made.

    Raises:
        ConfigError: the folder cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._writing = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: {reason_of(error)}") from error

    def read(self) -> Timestamps:
        """Return what the last run has left; nothing, and a line in the log, of a broken file.

        A drone whose file is broken is told the time by its peers; one that does not
        start for it is of no use.

        Raises:
            ConfigError: there is something that cannot be read.
        """
        try:
            with open(self._path, "rb") as file:
                data = file.read(_MAX_FILE_BYTES + 1)
        except FileNotFoundError:
            return Timestamps()
        except (OSError, ValueError) as error:
            raise ConfigError(f"{self._path}: {reason_of(error)}") from error
        try:
            return _decode(data)
        except (ValueError, TypeError, KeyError, RecursionError):
            _log.warning("%s is broken: signing starts anew", self._path)
            return Timestamps()

    def write(self, timestamps: Timestamps) -> str:
        """Put it on the disk, whole or not at all; return why that has failed, or nothing."""
        with self._writing:
            partial = self._path.with_name(f".{self._path.name}.partial")
            try:
                with open(partial, "wb") as file:
                    file.write(_encode(timestamps))
                    file.flush()
                    os.fsync(file.fileno())
                partial.replace(self._path)
            except OSError as error:
                with suppress(OSError):
                    partial.unlink()
                return reason_of(error)
            return ""


def _encode(timestamps: Timestamps) -> bytes:
    streams = [[*stream, at] for stream, at in sorted(timestamps.streams.items())]
    return json.dumps({"reserved": timestamps.reserved, "streams": streams}).encode() + b"\n"


def _decode(data: bytes) -> Timestamps:
    """Read a file's bytes; ValueError, TypeError, KeyError or RecursionError if not ours."""
    if len(data) > _MAX_FILE_BYTES:
        raise ValueError("too large")
    said = json.loads(data)
    streams = {}
    for system, component, link, at in said["streams"]:
        streams[_below(system, 256), _below(component, 256), _below(link, 256)] = _timestamp(at)
    return Timestamps(_timestamp(said["reserved"]), streams)


def _timestamp(value: object) -> int:
    return _below(value, _MAX_TIMESTAMP)


def _below(value: object, end: int) -> int:
    if type(value) is not int or not 0 <= value < end:
        raise ValueError("no such number")
    return value
