"""Signing as a daemon needs it: the key from its file, and timestamps that outlive the process."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

from vcl_companion.clock import Moment, system_moment
from vcl_companion.errors import DISK_IS_FULL, ConfigError
from vcl_companion.links.key_file import read_key_file
from vcl_companion.links.signing import Signing, SigningOptions
from vcl_companion.links.swarm_time import TICKS_PER_S, SwarmTime
from vcl_companion.links.timestamp_file import TimestampFile, Timestamps

_log = logging.getLogger(__name__)

# Written every five seconds, each time for ten; and soon after the time has jumped.
RESERVED_TICKS = 10 * TICKS_PER_S
_RENEWED_TICKS = 5 * TICKS_PER_S
# Who ends may still say something; who is started again at once must not be far ahead.
_END_TICKS = TICKS_PER_S
_LOOK_S = 0.5
_DISK_IS_FULL = frozenset(map(os.strerror, DISK_IS_FULL))


class KeptSigning:
    """One link's signing, and the file that is ahead of all that it signs.

    A disk that is full must not end the flight, nor keep a restart from going on with it: that
    is logged, and signing goes on.

    Args:
        key_file: the key; empty: nothing is signed.
        timestamp_file: what is remembered; empty: nothing.
        options: how strict it is.
        now: tells the time.

    Attributes:
        signing: signs and judges frames.
        now: tells the time.

    Raises:
        ConfigError: the key cannot be used, or the file cannot be written where there is room.
    """

    def __init__(
        self,
        key_file: str,
        timestamp_file: str,
        options: SigningOptions,
        now: Callable[[], Moment] = system_moment,
    ) -> None:
        self.now = now
        self._file: TimestampFile | None = None
        key, left = None, Timestamps()
        if key_file:
            try:
                key = read_key_file(Path(key_file))
            except ConfigError as error:
                is_missing = isinstance(error.__cause__, FileNotFoundError)
                advice = "; `vcl keys install` puts a key there" if is_missing else ""
                raise ConfigError(f"[peers] key_file: {error}{advice}") from error
            if timestamp_file:
                self._file = TimestampFile(Path(timestamp_file))
                left = self._file.read()
        self.signing = Signing(key, SwarmTime(left.reserved, now()), left.streams, options)
        self._reserved = left.reserved
        why = "" if self._file is None else self._file.write(self._ahead())
        if why in _DISK_IS_FULL:  # a restart in the air is part of the flight
            _log.error("%s: timestamps of signed frames cannot be kept: %s", timestamp_file, why)
        elif why:
            raise ConfigError(
                f"{timestamp_file}: timestamps of signed frames cannot be kept there ({why})"
            )

    async def run(self, disk: Executor | None = None) -> None:
        """Keep the file ahead of what is signed until cancelled; ``disk`` does the writing."""
        file = self._file
        if file is None:
            return
        loop = asyncio.get_running_loop()
        said = ""
        try:
            while True:
                await asyncio.sleep(_LOOK_S)
                if self.signing.time.at(self.now()) + _RENEWED_TICKS < self._reserved:
                    continue
                why = await loop.run_in_executor(disk, file.write, self._ahead())
                if why and why != said:
                    _log.error("timestamps of signed frames cannot be kept: %s", why)
                said = why
        finally:
            file.write(self._ahead(_END_TICKS))

    def _ahead(self, ticks: int = RESERVED_TICKS) -> Timestamps:
        """Return what to write now, so far ahead."""
        now = self.now()
        self._reserved = self.signing.time.at(now) + ticks
        return Timestamps(self._reserved, self.signing.marks(now))
