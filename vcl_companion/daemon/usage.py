"""What this process takes of the machine: told in the log's last line, and given back."""

from __future__ import annotations

import ctypes
import os
import resource
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_PROC = Path("/proc")
_MAPS = _PROC / "self/smaps"
_MADV_DONTNEED = 4  # <linux/mman.h>, the same on all architectures but alpha
_WORTH_KB = 256
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8  # <malloc.h>
# Blocks of so much go back to the system when they are freed, as does so much at the heap's end.
# Left to itself glibc raises the first to the largest block that was ever freed, 32 MB at most,
# and what a detector needs for a moment stays.
_LARGE_BYTES, _KEPT_BYTES = 1 << 20, 4 << 20
# Changed pages, those of relocated tables say, would come back as the file has them.
_CHANGED = ("Private_Dirty:", "Shared_Dirty:", "Anonymous:")


def cpu_s() -> float:
    """Return the processor time of all threads so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def peak_resident_mb() -> float:
    """Return the most memory that was resident, MiB.

    Not ``ru_maxrss``, where the kernel tells: that one survives exec, so that a
    small process started by a large one claims the large one's.
    """
    with suppress(OSError, ValueError, KeyError):
        return kilobytes("self/status")["VmHWM:"] / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def forget_peak() -> None:
    """Have ``peak_resident_mb`` begin anew (Linux); what it would have said is lost."""
    with suppress(OSError):
        (_PROC / "self/clear_refs").write_text("5", encoding="ascii")


def cpu_s_of(pid: int) -> float:
    """Return the processor time of all threads of a process so far; 0 where it is not told."""
    with suppress(OSError, ValueError, IndexError):
        # The name may hold blanks and brackets: what follows its last bracket counts.
        told = (_PROC / f"{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def kilobytes(file: str, proc: Path = _PROC) -> dict[str, int]:
    """Read the lines "Key: value kB" of a file of the kernel's.

    Raises:
        OSError, ValueError: there is none, or it is no text.
    """
    lines = (proc / file).read_text(encoding="utf-8").splitlines()
    fields = [line.split() for line in lines]
    return {f[0]: int(f[1]) for f in fields if len(f) == 3 and f[2] == "kB"}


def share_freed() -> None:
    """Let threads use what others have freed (glibc); call it before there are any.

    Otherwise each keeps what it needed most for itself, and making a map, recognising
    a frame and answering a peer take a hundred megabytes one after the other. Large blocks
    are given back to the system at once.
    """
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(_ARENA_MAX, 1)
        libc.mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
        libc.mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)


def give_back_freed() -> None:
    """Give blocks that were freed back to the system, where it knows how to (glibc)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(ctypes.c_size_t(0))


def give_back_files() -> None:
    """Give up pages that files still have; what is touched again is mapped again.

    The compiler is a hundred megabytes of libraries, read while compiled code is loaded and
    hardly again. Nothing happens where the system knows no such thing.
    """
    with suppress(OSError, AttributeError, ValueError):
        libc = ctypes.CDLL(None)
        for begin, end in list(_unchanged_file_pages(_MAPS.read_text(encoding="utf-8"))):
            libc.madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), _MADV_DONTNEED)


def _unchanged_file_pages(maps: str) -> Iterator[tuple[int, int]]:
    """Yield begin and end of mapped files that nobody can write to nor has changed.

    Args:
        maps: as of ``/proc/PID/smaps``: a line "begin-end rights offset device inode path" for
            each mapping, then lines "Key: value kB".
    """
    begin = end = 0
    is_file, kb = False, dict[str, int]()
    for line in maps.splitlines():
        first, *rest = line.split()
        if not first.endswith(":"):
            begin, end = (int(address, 16) for address in first.split("-"))
            is_file = len(rest) > 4 and rest[4].startswith("/") and "w" not in rest[0]
            kb = {}
        elif first != "VmFlags:":
            kb[first] = int(rest[0])
        elif is_file and kb["Rss:"] > _WORTH_KB and not any(kb.get(key, 1) for key in _CHANGED):
            yield begin, end
