"""The folder that a measurement leaves its results in: made, or one that has nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from vcl_companion.errors import ConfigError


@contextmanager
def result_folder(folder: Path, own: Sequence[str]) -> Iterator[None]:
    """Have a folder for results; what is written to it meanwhile may fail as it likes.

    Args:
        folder: made when absent.
        own: patterns of the names that are left there; a folder with others is somebody's.

    Raises:
        ConfigError: it holds something else, or cannot be written.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder}: is a file; give a folder")
        others = sorted(
            entry.name
            for entry in (folder.iterdir() if folder.is_dir() else ())
            if not any(fnmatchcase(entry.name, pattern) for pattern in own)
        )
        if others:
            raise ConfigError(f"{folder}: holds something else, {others[0]}; give another folder")
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror})") from error
