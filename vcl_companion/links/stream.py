"""Byte-stream links: a serial port or a TCP connection, without ever blocking the event loop."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import termios
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import serial

from vcl_companion.links.counters import LinkTally
from vcl_companion.links.reconnect import (
    Backoff,
    LinkLostError,
    OnBytes,
    Reconnecting,
    socket_at,
)

_CONNECT_TIMEOUT_S = 5.0
_MAX_READ_BYTES = 65536
# 45 ms at 921600 baud: more than this waiting means that what waits is stale.
MAX_WAITING_BYTES = 4096


class _Device(Protocol):
    def fileno(self) -> int: ...
    def close(self) -> None: ...


class StreamTransport(Reconnecting):
    """A link on a file descriptor; frames wait in a short queue when the device is busy.

    When the queue is full the oldest frame that has not begun to leave is
    dropped and counted: the newest pose is the one worth sending, and a frame
    is never cut in the middle.
    """

    is_stream: ClassVar[bool] = True

    def __init__(self, name: str, tally: LinkTally, backoff: Backoff) -> None:
        super().__init__(name, tally, backoff)
        self._fd: int | None = None
        self._waiting: deque[memoryview] = deque()
        self._waiting_bytes = 0
        self._first_begun = False

    @abstractmethod
    async def _open(self) -> _Device:
        """Open without blocking; the descriptor does not block either."""

    def write(self, data: bytes) -> None:
        """Send one frame, now or as soon as the device takes it."""
        if self._fd is None:
            self._tally.refuse("not sent: link is down")
            return
        self._waiting.append(memoryview(data))
        self._waiting_bytes += len(data)
        self._flush()
        while self._waiting_bytes > MAX_WAITING_BYTES and len(self._waiting) > 1:
            victim = self._waiting[1] if self._first_begun else self._waiting[0]
            del self._waiting[1 if self._first_begun else 0]
            self._waiting_bytes -= len(victim)
            self._tally.refuse("not sent: device is busy")

    def _flush(self) -> None:
        if self._fd is None:
            return
        while self._waiting:
            try:
                n_written = os.write(self._fd, self._waiting[0])
            except BlockingIOError:
                n_written = 0
            except OSError as error:
                self._fail(f"write failed: {error.strerror}")
                return
            self._tally.bytes_out += n_written
            self._waiting_bytes -= n_written
            if n_written < len(self._waiting[0]):
                self._first_begun = self._first_begun or n_written > 0
                self._waiting[0] = self._waiting[0][n_written:]
                asyncio.get_running_loop().add_writer(self._fd, self._flush)
                return
            self._waiting.popleft()
            self._first_begun = False
        asyncio.get_running_loop().remove_writer(self._fd)

    async def _serve(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        try:
            device = await self._open()
        except (OSError, ValueError, termios.error) as error:
            # pyserial raises ValueError for a speed the port cannot do.
            raise LinkLostError(f"cannot open: {error}") from error
        fd = device.fileno()
        try:
            self._fd = fd
            self._came_up(on_connected)
            while True:
                await self._readable(fd)
                try:
                    data = os.read(fd, _MAX_READ_BYTES)
                except BlockingIOError:
                    continue
                except OSError as error:
                    raise LinkLostError(f"read failed: {error.strerror}") from error
                if not data:
                    raise LinkLostError("closed by the other side, or unplugged")
                self._took(len(data))
                on_bytes(data, None)
        finally:
            self._fd = None
            self._waiting.clear()
            self._waiting_bytes = 0
            self._first_begun = False
            asyncio.get_running_loop().remove_writer(fd)
            with contextlib.suppress(OSError, termios.error):
                device.close()


class SerialTransport(StreamTransport):
    """A serial port, opened exclusively so that two daemons cannot share it."""

    def __init__(self, device: str, baud: int, tally: LinkTally, backoff: Backoff) -> None:
        super().__init__(f"serial:{device}:{baud}", tally, backoff)
        self._device = device
        self._baud = baud

    async def _open(self) -> _Device:
        # timeout 0 leaves the descriptor in pyserial's O_NONBLOCK mode with VMIN 0.
        try:
            return serial.Serial(
                self._device, self._baud, timeout=0, write_timeout=0, exclusive=True
            )
        except serial.SerialException as error:
            if error.errno == errno.EAGAIN:
                raise OSError("another program has it open") from error
            if error.errno:  # its own text names the device once more
                raise OSError(os.strerror(error.errno)) from error
            raise


class TcpTransport(StreamTransport):
    """A TCP connection that notices within seconds when the other side has vanished."""

    def __init__(self, host: str, port: int, tally: LinkTally, backoff: Backoff) -> None:
        super().__init__(f"tcp:{host}:{port}", tally, backoff)
        self._host = host
        self._port = port

    async def _open(self) -> _Device:
        async with asyncio.timeout(_CONNECT_TIMEOUT_S):
            return await socket_at(self._host, self._port, socket.SOCK_STREAM, _connect)


async def _connect(connection: socket.socket, address: Any) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 3)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT, 3)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 5000)
    await asyncio.get_running_loop().sock_connect(connection, address)
