"""Key files: the secret that a swarm signs with, made once and copied to every drone.

A file is one line of 64 hexadecimal digits, 32 random bytes. The line is a passphrase as
QGroundControl, MAVProxy and Mission Planner take it, and the key is, as with them, its
SHA-256: a ground station is given the line.

What goes wrong is told without a word of what is in the file.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import stat
from contextlib import suppress
from pathlib import Path

from vcl_companion.errors import ConfigError
from vcl_companion.links.signing import SECRET_BYTES, SigningKey
from vcl_companion.text_file import at_once

_PASSPHRASE = re.compile(rf"[0-9a-f]{{{2 * SECRET_BYTES}}}")
_MAX_FILE_BYTES = 1024
_FORBIDDEN = stat.S_IWGRP | stat.S_IXGRP | stat.S_IRWXO
_PRIVATE, _SHARED_WITH_GROUP = 0o600, 0o640


def make_key_file(path: Path) -> SigningKey:
    """Write a new random key, for nobody but its owner to read, and return it.

    Raises:
        ConfigError: there is something already, which is left alone, or it cannot be written.
    """
    passphrase = secrets.token_hex(SECRET_BYTES)
    try:
        _write(path, passphrase, _PRIVATE)
    except FileExistsError:
        raise ConfigError(f"{path}: is there already; a key is never overwritten") from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {_why(error)}") from error
    return _key_of(passphrase)


def read_key_file(path: Path) -> SigningKey:
    """Return the key in a file.

    Raises:
        ConfigError: it cannot be read, others can read it, or it is no key file.
    """
    return _key_of(read_passphrase(path))


def read_passphrase(path: Path) -> str:
    """Return the secret line of a key file, for ground stations.

    Raises:
        ConfigError: as ``read_key_file``.
    """
    try:
        with open(path, "rb", opener=at_once) as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise ConfigError(f"{path}: is no file")
            if about.st_mode & _FORBIDDEN:
                raise ConfigError(
                    f"{path}: others can read or change this key (mode "
                    f"{stat.S_IMODE(about.st_mode):03o}); run `chmod 600 {path}`, and make a new "
                    "key if somebody may have read it"
                )
            text = _text_of(file.read(_MAX_FILE_BYTES + 1))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {_why(error)}") from error
    if not _PASSPHRASE.fullmatch(text):
        raise ConfigError(f"{path}: is no key file; `vcl keys new` makes one")
    return text


def install_key_file(source: Path, target: Path, like: Path | None = None) -> SigningKey:
    """Copy a key to where a daemon looks for it, in place of one that may be there.

    Args:
        source: the key file.
        target: the file that it becomes.
        like: a file, the daemon's configuration, that gives the copy owner and group: who
            can read it is to read the key. Its group can only if others cannot read that
            file either. None: only the user who runs this.

    Returns:
        The key.

    Raises:
        ConfigError: the source is no key file, the target is something else, or it cannot be
            written.
    """
    passphrase = read_passphrase(source)
    _check_may_go(target)
    partial = target.with_name(f".{target.name}.partial")
    try:
        about = None if like is None else like.stat()
        with suppress(FileNotFoundError):
            partial.unlink()
        _write(partial, passphrase, _PRIVATE)
        try:
            if about is not None:
                os.chown(partial, about.st_uid, about.st_gid)
                readers = about.st_mode & (stat.S_IRGRP | stat.S_IROTH)
                os.chmod(partial, _SHARED_WITH_GROUP if readers == stat.S_IRGRP else _PRIVATE)
            partial.replace(target)
        except OSError:
            partial.unlink(missing_ok=True)
            raise
    except (OSError, ValueError) as error:
        raise ConfigError(f"{target}: cannot be installed ({_why(error)})") from error
    return _key_of(passphrase)


def _check_may_go(target: Path) -> None:
    """Make sure that nothing but a key, or a file that is empty, is replaced by one.

    Raises:
        ConfigError: it is something else.
    """
    try:
        with open(target, "rb", opener=at_once) as file:
            is_file = stat.S_ISREG(os.fstat(file.fileno()).st_mode)
            text = _text_of(file.read(_MAX_FILE_BYTES + 1)) if is_file else ""
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise ConfigError(f"{target}: cannot be installed ({_why(error)})") from error
    if not is_file or (text and not _PASSPHRASE.fullmatch(text)):
        raise ConfigError(f"{target}: is there, and is no key file; remove it, or name another one")


def _write(path: Path, passphrase: str, mode: int) -> None:
    """Write a file that is not there yet, and that nobody else could read for a moment."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with open(descriptor, "w", encoding="ascii") as file:
            os.fchmod(descriptor, mode)  # whatever the umask
            file.write(passphrase + "\n")
            file.flush()
            os.fsync(descriptor)
    except OSError:  # a full disk: what is left is no key, and would keep one from being made
        path.unlink(missing_ok=True)
        raise


def _text_of(data: bytes) -> str:
    """Return what a file says, without the mark that some editors begin a text with."""
    return data.decode("utf-8-sig", errors="replace").strip()


def _key_of(passphrase: str) -> SigningKey:
    return SigningKey(hashlib.sha256(passphrase.encode("ascii")).digest())


def _why(error: OSError | ValueError) -> str:
    if isinstance(error, FileNotFoundError) and error.filename:
        folder = Path(error.filename).parent
        if not folder.is_dir():
            return f"there is no folder {folder}; make it first"
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
