"""A network of a process's own: nothing in it but a loopback, so that fixed ports are free."""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct

from vcl_companion.errors import ConfigError

# linux/sched.h, linux/sockios.h, linux/if.h
_NEW_USERS, _NEW_NETWORK = 0x10000000, 0x40000000
_GET_FLAGS, _SET_FLAGS = 0x8913, 0x8914
_UP = 0x1
_REQUEST = struct.Struct("16sh22x")


def enter_own_network() -> None:
    """Leave the machine's network for a new one; sockets that are open stay in the old one.

    Needs root, or a kernel that gives user namespaces to anybody and a process of one thread.

    Raises:
        ConfigError: the kernel does not allow it.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_NEW_NETWORK) != 0 and libc.unshare(_NEW_USERS | _NEW_NETWORK) != 0:
        reason = os.strerror(ctypes.get_errno())
        raise ConfigError(
            f"no network namespace for the firmware ({reason}): "
            "run as root, or allow unprivileged user namespaces"
        )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        answer = fcntl.ioctl(control, _GET_FLAGS, _REQUEST.pack(b"lo", 0))
        flags = _REQUEST.unpack(answer)[1]
        fcntl.ioctl(control, _SET_FLAGS, _REQUEST.pack(b"lo", flags | _UP))
