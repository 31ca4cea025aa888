"""The exceptions that leave a module on purpose; everything else is a bug."""

import errno

DISK_IS_FULL = frozenset((errno.ENOSPC, errno.EDQUOT))
"""Of an OSError: what was to be kept cannot be, and a restart in the air goes on without."""


def reason_of(error: OSError | ValueError) -> str:
    """Return what a file's error says to a person, without its number and the path."""
    return getattr(error, "strerror", None) or str(error)


class VclError(Exception):
    """A failure whose message is one line for a person: what, where, what to do."""


class ConfigError(VclError):
    """A configuration file or option cannot be used as it stands."""


class RecordingError(VclError):
    """A recording on disk is broken; the message names the file and the row."""


class WireError(VclError):
    """Bytes from a peer are not what they claim to be; never raised past the border."""


class DeviceError(VclError):
    """A camera, serial port or socket cannot be used."""
