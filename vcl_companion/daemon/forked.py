"""A process of its own for the methods of an object, forked off this one.

A thread beside the frames' would not do: each holds the interpreter's lock for as long
as one call into a library takes, and a nice one holds it while it waits for a processor.
Forked rather than started anew, it shares what this process has loaded and compiled.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import signal
import socket
import struct
import sys
import threading
import time
import traceback
from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

from vcl_companion.daemon.scheduling import run_before_others
from vcl_companion.daemon.shared_arrays import PROTOCOL, SharedMemory, place_of
from vcl_companion.daemon.usage import cpu_s_of
from vcl_companion.daemon.worker import Worker

# Numbers of shared memories and of arrays, bytes of the stream; then the bytes of each memory;
# then of each array its bytes, which memory it lies in, and where there.
_HEAD, _LENGTH, _PART = struct.Struct("<QQQ"), struct.Struct("<Q"), struct.Struct("<QQQ")
_NOT_SHARED = (1 << 64) - 1
# A map's arrays lie in a few; the kernel takes 253 files at a time.
_MOST_MEMORIES = 64
_END_S = 2.0
_LOOK_S = 0.01
END_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""What asks a service to end; the last: the terminal that it was started from is gone."""


class ProcessLostError(Exception):
    """The process has ended before it was told to, and what it was asked for is not done."""


class Forked:
    """Calls methods of an object in a process of its own.

    Make it when no other thread is at work: the child has this one only. The child ends
    with this process, however that ends; interrupts from the terminal it leaves to it.

    Args:
        target: whose methods are called; the child's copy and this one know nothing of
            each other.
        lanes: niceness above ours of each thread of the child's, by name. A thread does one
            call after the other.
        realtime: whether our own ends of it go before other programs, where that is
            permitted: they hold the interpreter's lock now and then.

    Attributes:
        pid: the process's id.
    """

    def __init__(self, target: object, lanes: Mapping[str, int], *, realtime: bool = False) -> None:
        self._socket, other = socket.socketpair()
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        self.pid = os.fork()
        if self.pid == 0:
            self._socket.close()
            _serve(other, target, lanes)
        other.close()
        self._calls: dict[int, Future[Any]] = {}
        self._ids = itertools.count()
        self._lock = threading.Lock()
        self._is_lost = False
        # Never the event loop's thread: the child may be slow to read.
        self._writer = Worker("to-forked")
        self._realtime = realtime
        if realtime:
            self._writer.submit(run_before_others)
        self._reader = threading.Thread(target=self._read, name="from-forked", daemon=True)
        self._reader.start()

    def call(self, lane: str, method: str, *args: object) -> Future[Any]:
        """Have a method called; arguments and result are copied.

        Returns:
            What it returns or raises, with the child's traceback as a note; ``ProcessLostError``
            when the process is not there any more.
        """
        future: Future[Any] = Future()
        with self._lock:
            number = next(self._ids)
            self._calls[number] = future
            is_lost = self._is_lost
        if is_lost:
            self._answer(number, False, ProcessLostError("the process has ended"))
        else:
            self._writer.submit(self._write, number, lane, method, args)
        return future

    def cpu_s(self) -> float:
        """Return the processor time that the process has taken so far; 0 when it is not there."""
        return cpu_s_of(self.pid)

    def end(self) -> None:
        """End the process, whatever it is doing; what was asked for is lost."""
        self._writer.shutdown(wait=False, cancel_futures=True)
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._reader.join()
        self._socket.close()
        until_s = time.monotonic() + _END_S
        while not self._is_over():
            if time.monotonic() >= until_s:
                os.kill(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                break
            time.sleep(_LOOK_S)

    def _is_over(self) -> bool:
        try:
            return os.waitpid(self.pid, os.WNOHANG)[0] != 0
        except ChildProcessError:
            return True

    def _write(self, number: int, lane: str, method: str, args: tuple[object, ...]) -> None:
        try:
            _send(self._socket, (number, lane, method, args))
        except OSError:
            self._answer(number, False, ProcessLostError("the process has ended"))
        except Exception as error:  # what cannot be copied is the caller's mistake, nobody else's
            self._answer(number, False, error)

    def _read(self) -> None:
        if self._realtime:
            run_before_others()
        # Whatever it is, too little memory say, nothing that comes after it can be read.
        with contextlib.suppress(Exception):
            while True:
                self._answer(*_receive(self._socket))
        with self._lock:
            self._is_lost = True
            left = list(self._calls)
        for number in left:
            self._answer(number, False, ProcessLostError("the process has ended"))

    def _answer(self, number: int, is_done: bool, result: Any) -> None:
        with self._lock:
            future = self._calls.pop(number, None)
        if future is None or not future.set_running_or_notify_cancel():
            return
        if is_done:
            future.set_result(result)
        else:
            future.set_exception(result)


def _serve(connection: socket.socket, target: object, lanes: Mapping[str, int]) -> None:
    """Do what is asked for until the other side hangs up, and end the process."""
    try:
        _leave_parent(connection.fileno())
        workers = {name: Worker(name, yields) for name, yields in lanes.items()}
        answering = threading.Lock()
        with contextlib.suppress(OSError, EOFError):
            while True:
                number, lane, method, args = _receive(connection)
                workers[lane].submit(_do, connection, answering, number, target, method, args)
                del args
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    # Threads are not waited for: nobody is there whom their results concern.
    os._exit(0)


def _leave_parent(keep: int) -> None:
    """Let go of what is the parent's: its signals, and its files and sockets but one."""
    signal.set_wakeup_fd(-1)
    for end in END_SIGNALS:
        signal.signal(end, signal.SIG_IGN)
    for name in os.listdir("/dev/fd"):
        number = int(name)
        if number > 2 and number != keep:
            with contextlib.suppress(OSError):  # the listing's own is gone by now
                os.close(number)


def _do(
    connection: socket.socket,
    answering: threading.Lock,
    number: int,
    target: object,
    method: str,
    args: tuple[object, ...],
) -> None:
    """Call a method and send what came of it."""
    is_done, result = True, None
    try:
        result = getattr(target, method)(*args)
    except Exception as error:
        is_done, result = False, _portable(error)
    del args
    try:
        with answering:
            _send(connection, (number, is_done, result))
    except OSError:
        os._exit(0)
    except Exception as error:  # pickle raises whatever it likes, before a byte is sent
        with answering:
            _send(connection, (number, False, _portable(error)))


def _portable(error: Exception) -> Exception:
    """Return an exception that the other side can read, with its traceback as a note."""
    error.add_note("".join(traceback.format_exception(error)).rstrip())
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        told = RuntimeError(f"{type(error).__name__}: {error}")
        told.add_note("".join(traceback.format_exception(error)).rstrip())
        return told
    return error


def _send(connection: socket.socket, message: object) -> None:
    """Send a message: numbers and lengths; the stream; the bytes of each array that is not shared.

    Of one that lies in shared memory only the place is told; the memory's file goes with the
    first bytes.
    """
    arrays: list[pickle.PickleBuffer] = []
    stream = pickle.dumps(message, protocol=PROTOCOL, buffer_callback=arrays.append)
    parts = [array.raw() for array in arrays]
    places = [place_of(part) for part in parts]
    known = {id(place.memory): place.memory for place in places if place}
    memories = list(known.values())[:_MOST_MEMORIES]
    number = {id(memory): n for n, memory in enumerate(memories)}
    rows = [
        (number.get(id(place.memory), _NOT_SHARED), place.begin) if place else (_NOT_SHARED, 0)
        for place in places
    ]
    table = b"".join(_PART.pack(part.nbytes, *row) for part, row in zip(parts, rows, strict=True))
    lengths = b"".join(_LENGTH.pack(len(memory)) for memory in memories)
    head = _HEAD.pack(len(memories), len(parts), len(stream))
    if memories:
        sent = socket.send_fds(connection, [head], [memory.descriptor for memory in memories])
        head = head[sent:]
    connection.sendall(head + lengths + table + stream)
    for part, (n, _) in zip(parts, rows, strict=True):
        if n == _NOT_SHARED:
            connection.sendall(part)


def _receive(connection: socket.socket) -> Any:
    """Wait for a message.

    Raises:
        EOFError: the other side has hung up.
        OSError: shared memory that belongs to it has not come, or cannot be mapped.
    """
    head, files, _, _ = socket.recv_fds(connection, _HEAD.size, _MOST_MEMORIES)
    if not head:
        raise EOFError("the other side has hung up")
    head += _exactly(connection, _HEAD.size - len(head))
    n_memories, n_arrays, n_stream = _HEAD.unpack(head)
    lengths = _LENGTH.iter_unpack(_exactly(connection, n_memories * _LENGTH.size))
    if len(files) != n_memories:  # as where too many are open
        raise OSError(f"{len(files)} of {n_memories} files of shared memory have come")
    memories = [SharedMemory(file, length) for file, (length,) in zip(files, lengths, strict=True)]
    for memory in memories:
        memory.touch()
    table = _exactly(connection, n_arrays * _PART.size)
    stream = _exactly(connection, n_stream)
    arrays = [
        _exactly(connection, size)
        if number == _NOT_SHARED
        else memoryview(memories[number])[begin : begin + size]
        for size, number, begin in _PART.iter_unpack(table)
    ]
    return pickle.loads(stream, buffers=arrays)


def _exactly(connection: socket.socket, n: int) -> bytearray:
    data = bytearray(n)
    rest = memoryview(data)
    while rest:
        got = connection.recv_into(rest)
        if got == 0:
            raise EOFError("the other side has hung up")
        rest = rest[got:]
    return data
