"""The most memory that a daemon's two processes had at one time, for the log's last line.

That is not the sum of what each had at most: they had it at different times, and what was there
before the fork, and the maps in use, both have.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from vcl_companion.daemon.usage import kilobytes

# Making a map takes what it takes for longer than that.
_EVERY_S = 0.2


class MemoryWatch:
    """Looks at both processes now and then; what they share counts once.

    Args:
        forked_pid: tells the other one's process id; None when there is none.
    """

    def __init__(self, forked_pid: Callable[[], int | None]) -> None:
        self._forked_pid = forked_pid
        self._most_kb = 0

    async def run(self) -> None:
        """Look until cancelled."""
        while True:
            self.look()
            await asyncio.sleep(_EVERY_S)

    def look(self) -> None:
        """Note what both have resident now, where the kernel tells (Linux)."""
        with suppress(OSError, ValueError, KeyError):
            self._most_kb = max(self._most_kb, self._both_kb())

    def now_mb(self) -> float:
        """Return what both have resident now, MiB; 0 where the kernel does not tell."""
        with suppress(OSError, ValueError, KeyError):
            return (self._both_kb() - self._from_before_kb()) / 1024
        return 0.0

    def most_mb(self) -> float:
        """Return the most that was seen, MiB; 0 where the kernel does not tell.

        What both have from before the fork becomes less: it is what it is now.
        """
        with suppress(OSError, ValueError, KeyError):
            return (self._most_kb - self._from_before_kb()) / 1024
        return 0.0

    def _both_kb(self) -> int:
        """Return the sum of what each has, of the maps that both have one's."""
        ours = kilobytes("self/status")
        pid = self._forked_pid()
        if pid is None:
            return ours["VmRSS:"]
        theirs = kilobytes(f"{pid}/status")
        return ours["VmRSS:"] + theirs["VmRSS:"] - min(ours["RssShmem:"], theirs["RssShmem:"])

    def _from_before_kb(self) -> int:
        """Return what the other one shares with this one, and maybe others, but for maps."""
        pid = self._forked_pid()
        if pid is None:
            return 0
        pages = kilobytes(f"{pid}/smaps_rollup")
        maps = min(kilobytes(f"{name}/status")["RssShmem:"] for name in ("self", str(pid)))
        return max(pages["Shared_Clean:"] + pages["Shared_Dirty:"] - maps, 0)
