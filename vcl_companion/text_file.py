"""Files that people write, read to a limit: a device or a pipe of that name has no end."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

_MOST_BYTES = 16 << 20


def read_text(path: Path, most_bytes: int = _MOST_BYTES) -> str:
    """Return what a file says, without a byte order mark.

    Args:
        path: the file.
        most_bytes: longer ones are something else.

    Raises:
        OSError: it cannot be read, is no file, or too long.
        UnicodeDecodeError: it is no UTF-8 text.
    """
    with open(path, "rb", opener=at_once) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "is no regular file")
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"is longer than {most_bytes >> 20} MiB")
    return data.decode("utf-8-sig")


def at_once(path: str, flags: int) -> int:
    """Open a file without waiting: a pipe of that name may have nobody at its other end."""
    return os.open(path, flags | os.O_NONBLOCK)
