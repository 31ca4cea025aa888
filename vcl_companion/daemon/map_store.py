"""The map a drone flies on: one revision at a time, replaced by one assignment."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import re
import tempfile
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from vcl_companion.daemon.whole_file import write_whole
from vcl_companion.errors import DISK_IS_FULL, ConfigError, reason_of
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.mapping.templates import Templates
from vcl_companion.wire.map_codec import REVISION_BYTES, revision_of

_log = logging.getLogger(__name__)

_MAX_LEFT = 256  # revisions remembered by name
_KEPT_BYTES = 256 << 20  # a thousand of a quarter of a megabyte, as small maps are
_REVISION = re.compile(f"[0-9a-f]{{{2 * REVISION_BYTES}}}")
SAVED_FILE = "saved.vclmap"
# Several times the longest of maps; a file that is longer is something else.
_MAX_FILE_BYTES = 64 << 20


@dataclass(frozen=True, eq=False)
class StoredMap:
    """A revision in use.

    Attributes:
        revision: its content hash.
        data: its encoded form, as handed on to peers.
        index: ready to be recognised.
        update: the same for one who has its parent (``map_update``); empty when
            we do not have that ourselves.
        templates: ready to be tracked; None when it is not to be.
        part_of: the revision that this is a part of (``map_part``); empty for a whole map.
    """

    revision: bytes
    data: bytes
    index: MapIndex
    update: bytes = b""
    templates: Templates | None = None
    part_of: bytes = b""

    @property
    def told_revision(self) -> bytes:
        """What peers are told that we have: nothing yet, of a part."""
        return b"" if self.part_of else self.revision

    @property
    def parent(self) -> bytes:
        """The revision that it was made from; empty for a first map."""
        return self.index.landmark_map.parent

    @property
    def world(self) -> bytes:
        """The frame that it is in."""
        return self.index.landmark_map.world_of(self.revision)

    def has_in_it(self, revision: bytes) -> bool:
        """Whether another map was merged into it, or into one that it was made from."""
        return any(other.revision == revision for other in self.index.landmark_map.joined)

    @property
    def n_landmarks(self) -> int:
        """Number of landmarks."""
        return len(self.index.landmark_map.points_world)


class MapStore:
    """Holds the current revision, and tells those who wait for one.

    A revision stays in use until the next one is ready for use; the ones that
    were left are known by name.

    Args:
        directory: where revisions are kept as ``<revision>.vclmap``, and the one to begin with as
            ``saved.vclmap``; empty for nowhere.
        kept_bytes: of revisions of all flights together, the newest.

    Raises:
        ConfigError: the directory cannot be made, or no file in it.
    """

    def __init__(self, directory: str, kept_bytes: int = _KEPT_BYTES) -> None:
        self._kept_bytes = kept_bytes
        self._written: dict[Path, int] = {}  # in this run, and their order
        self.current: StoredMap | None = None
        self.is_improved = False
        """Whether the one in use has had a better index made of it since it came."""
        self.refusal = ""
        self._directory = Path(directory) if directory else None
        self._left: deque[bytes] = deque(maxlen=_MAX_LEFT)
        self._decided = asyncio.Event()
        self._more_wanted = asyncio.Event()
        if self._directory is not None:
            try:
                self._directory.mkdir(parents=True, exist_ok=True)
                # Permission bits do not tell of read-only or odd file systems: try.
                with tempfile.TemporaryFile(dir=self._directory):
                    pass
            except (OSError, ValueError) as error:
                why = reason_of(error)
                if getattr(error, "errno", None) not in DISK_IS_FULL:
                    raise ConfigError(f"[map] directory {directory!r}: {why}") from error
                _log.error("no map can be kept in %s: %s", directory, why)

    def replace(
        self,
        data: bytes,
        index: MapIndex,
        update: bytes = b"",
        templates: Templates | None = None,
        part_of: bytes = b"",
    ) -> StoredMap:
        """Fly on this map from the next frame on."""
        stored = StoredMap(revision_of(data), data, index, update, templates, part_of)
        if self.current is not None and self.current.revision != stored.revision:
            self._left.append(self.current.revision)
        self.current = stored
        self.is_improved = False
        self.refusal = ""
        self._decided.set()
        return stored

    def has_left_world(self, world: bytes) -> bool:
        """Whether the map in use is of another world: what was found in this one says nothing."""
        return self.current is not None and self.current.world != world

    def improve(self, stored: StoredMap, index: MapIndex) -> None:
        """Recognise a revision by a better index from the next frame on, if it is still in use."""
        if self.current is stored:
            self.current = replace(stored, index=index)
            self.is_improved = True
            self._decided.set()

    def want_more(self) -> None:
        """Ask for the other detectors' indexes of the map in use: its own did not suffice."""
        self._more_wanted.set()

    async def more_wanted(self) -> None:
        """Wait until somebody asks for them."""
        await self._more_wanted.wait()
        self._more_wanted.clear()

    def is_in_use(self, stored: StoredMap | None) -> bool:
        """Whether we fly on a revision, or, for None, on no map at all."""
        if self.current is None or stored is None:
            return self.current is stored
        return self.current.revision == stored.revision

    def has_left(self, revision: bytes) -> bool:
        """Whether a revision was in use here, or is the one that ours was made from."""
        current = self.current
        if current is None or not revision or current.revision == revision:
            return False
        return revision in self._left or revision == current.parent

    def refuse(self, reason: str) -> None:
        """Let those who wait for a first map know that there is none this time, and why."""
        if self.current is None:
            self.refusal = reason
            self._decided.set()

    async def decided(self) -> StoredMap | None:
        """Wait until there is a map, or until the next attempt at a first one has failed."""
        if self.current is None:
            self._decided.clear()
            await self._decided.wait()
        return self.current

    async def newer_than(self, stored: StoredMap | None) -> None:
        """Wait until another map than this one is in use, or a better index of it."""
        while self.current is stored:
            self._decided.clear()
            await self._decided.wait()

    def keep(self, stored: StoredMap) -> None:
        """Write a revision to the directory; takes as long as the disk does, any thread may.

        Written beside and renamed when it is on the disk, so that a power cut
        leaves no half map. A disk that is full must not end the flight: the
        failure is logged. Nor must maps fill it: the oldest have to go.
        """
        if self._directory is None:
            return
        path = self._directory / _file_of(stored.revision)
        try:
            write_whole(path, stored.data)
            self._written[path] = len(self._written)
            _remove_oldest(self._directory, self._kept_bytes, self._written)
        except OSError as error:
            _log.error("the map %s cannot be kept: %s", path, error.strerror)

    @property
    def directory(self) -> Path | None:
        """Where revisions are kept; None for nowhere."""
        return self._directory

    def kept(self, revision: bytes) -> bytes:
        """Return an encoded revision that was kept; nothing is known of its bytes. Any thread may.

        Raises:
            OSError: it cannot be read; FileNotFoundError: it was not kept, or is not any more.
        """
        return _read(self._directory and self._directory / _file_of(revision))

    @property
    def saved_file(self) -> Path | None:
        """The map to begin with after a restart, if there is one; None without a directory."""
        return None if self._directory is None else self._directory / SAVED_FILE

    def save(self, stored: StoredMap) -> None:
        """Write a revision down to begin with, in the place of any other; any thread may.

        Raises:
            OSError: it cannot be written; what was there stays.
        """
        if self.saved_file is not None:
            write_whole(self.saved_file, stored.data)

    def saved(self) -> bytes:
        """Return the encoded map to begin with; nothing is known of its bytes. Any thread may.

        Raises:
            OSError: it cannot be read; FileNotFoundError: there is none.
        """
        return _read(self.saved_file)

    def forget_saved(self) -> None:
        """Begin with no map after a restart; any thread may.

        Raises:
            OSError: the file cannot be removed.
        """
        if self.saved_file is not None:
            self.saved_file.unlink(missing_ok=True)


def _file_of(revision: bytes) -> str:
    return f"{revision.hex()}.vclmap"


def _read(path: Path | None) -> bytes:
    if path is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
    with path.open("rb") as file:
        data = file.read(_MAX_FILE_BYTES + 1)
    if len(data) > _MAX_FILE_BYTES:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    return data


def _remove_oldest(directory: Path, kept_bytes: int, written: Mapping[Path, int]) -> None:
    """Remove what is beyond so many bytes of revisions, but never the newest one.

    Args:
        directory: where they are.
        kept_bytes: of all of them.
        written: those of this run, in their order: newer than all others, whatever a clock
            says that was not set yet, then or now.

    Raises:
        OSError: that has failed.
    """
    # By revision: the saved one, and whatever else is there, is not ours to remove.
    found = []
    for file in directory.glob("*.vclmap"):
        if _REVISION.fullmatch(file.stem):
            with suppress(FileNotFoundError):
                found.append((written.get(file, -1), file.stat(), file))
    found.sort(key=lambda one: (one[0], one[1].st_mtime_ns), reverse=True)
    n_bytes = 0
    for k, (_, status, file) in enumerate(found):
        n_bytes += status.st_size
        if n_bytes > kept_bytes and k > 0:
            file.unlink(missing_ok=True)
