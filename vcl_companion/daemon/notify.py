"""Tell systemd how the service is: sd_notify(3) without its library.

Every function returns silently when the service manager does not listen
(NOTIFY_SOCKET is not set) or cannot be reached: being watched is its concern.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress


def ready() -> None:
    """Say that start-up is complete (``Type=notify`` waits for it)."""
    _send("READY=1")


def watchdog() -> None:
    """Say that the service is alive; due more often than ``WatchdogSec``."""
    _send("WATCHDOG=1")


def stopping() -> None:
    """Say that the service has begun to shut down."""
    _send("STOPPING=1")


def status(text: str) -> None:
    """Show ``text`` in ``systemctl status``; one line, line breaks become spaces."""
    _send("STATUS=" + " ".join(text.split()))


def _send(state: str) -> None:
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    if address[0] == "@":  # an abstract socket: its name starts with a zero byte
        address = "\0" + address[1:]
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.setblocking(False)
        sender.sendto(state.encode(), address)
