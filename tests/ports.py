"""Ports on loopback for those that are told them before they listen."""

from __future__ import annotations

import random
import socket

# Below what systems give to sockets that ask for any: no such socket takes one meanwhile.
_FIRST, _LAST = 10_000, 32_000


def free_ports(n: int) -> list[int]:
    """Return UDP ports of 127.0.0.1 that nobody listens on."""
    found: set[int] = set()
    while len(found) < n:
        port = random.randint(_FIRST, _LAST)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            try:
                one.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.add(port)
    return sorted(found)
