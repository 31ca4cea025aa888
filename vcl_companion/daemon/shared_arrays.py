"""Large arrays in memory that two processes have in common: a map is there once, not twice.

The process that makes maps needs them as much as the one that flies on them does, and a large
map is sixty megabytes. Its arrays are put into a file without a name, in memory, and both map
that; what is handed over is the file.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import pickle
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np

_Value = TypeVar("_Value")

PROTOCOL = 5
"""Of pickle: large arrays beside the stream, not in it."""

# Smaller ones are copied: the memory goes when the last of its arrays does, and a small one may
# be kept for seconds after its map has been left.
_LARGE_BYTES = 1 << 18
_ALIGNED_BYTES = 64
_MADV_POPULATE_READ = 22  # <linux/mman.h>


class SharedMemory(mmap.mmap):
    """Memory of a file that another process can map too.

    What one of them writes, the other does not see.

    Args:
        descriptor: the file's, closed with this.
        n_bytes: its length.
    """

    descriptor: int

    def __new__(cls, descriptor: int, n_bytes: int) -> SharedMemory:
        """Map the file.

        Raises:
            OSError: it cannot be mapped; the descriptor is closed.
        """
        try:
            memory = super().__new__(cls, descriptor, n_bytes, access=mmap.ACCESS_COPY)
        except OSError:
            os.close(descriptor)
            raise
        memory.descriptor = descriptor
        return memory

    def __del__(self) -> None:
        os.close(self.descriptor)

    def touch(self) -> None:
        """Have all of it at hand, where the system can (Linux 5.14): no frame waits for a page."""
        with suppress(OSError, AttributeError):
            # Not the own ``madvise``, which holds the interpreter's lock meanwhile.
            ctypes.CDLL(None).madvise(
                ctypes.c_void_p(_address(memoryview(self))),
                ctypes.c_size_t(len(self)),
                _MADV_POPULATE_READ,
            )


@dataclass(frozen=True, eq=False)
class Place:
    """Where in such memory an array lies."""

    memory: SharedMemory
    begin: int


def place_of(array: memoryview) -> Place | None:
    """Return where in shared memory the bytes of an array are; None for an array of our own.

    Args:
        array: as ``pickle.PickleBuffer.raw`` gives it.
    """
    owner: object = array
    while True:
        if isinstance(owner, memoryview):
            owner = owner.obj
        elif isinstance(owner, np.ndarray):
            owner = owner.base
        else:
            break
    if not isinstance(owner, SharedMemory):
        return None
    return Place(owner, _address(array) - _address(memoryview(owner)))


def shared(value: _Value) -> _Value:
    """Return a copy of a value whose large arrays lie in memory that can be shared.

    Those that do so already stay where they are. Where the system has no such files (Linux
    has), the value itself is returned.
    """
    arrays: list[memoryview] = []

    def stays_in_the_stream(buffer: pickle.PickleBuffer) -> bool:
        array = buffer.raw()
        if array.nbytes < _LARGE_BYTES:
            return True
        arrays.append(array)
        return False

    stream = pickle.dumps(value, protocol=PROTOCOL, buffer_callback=stays_in_the_stream)
    ours = [array for array in arrays if place_of(array) is None]
    if not ours:
        return value
    lengths = [-(-array.nbytes // _ALIGNED_BYTES) * _ALIGNED_BYTES for array in ours]
    begins = np.concatenate([[0], np.cumsum(lengths)])
    try:
        descriptor = os.memfd_create("arrays")
    except (AttributeError, OSError):
        return value
    memory = _filled(descriptor, ours, begins)
    if memory is None:
        return value
    where = {
        id(array): memoryview(memory)[begin : begin + array.nbytes]
        for array, begin in zip(ours, begins[:-1].tolist(), strict=True)
    }
    loaded = pickle.loads(stream, buffers=[where.get(id(array), array) for array in arrays])
    return cast("_Value", loaded)


def _filled(descriptor: int, arrays: list[memoryview], begins: np.ndarray) -> SharedMemory | None:
    """Write arrays to a file and map it; None, and the file is closed, where that fails."""
    try:
        os.ftruncate(descriptor, int(begins[-1]))
        for array, begin in zip(arrays, begins[:-1].tolist(), strict=True):
            written = 0
            while written < array.nbytes:
                written += os.pwrite(descriptor, array[written:], begin + written)
    except OSError:
        os.close(descriptor)
        return None
    try:
        return SharedMemory(descriptor, int(begins[-1]))
    except OSError:
        return None


def _address(bytes_: memoryview) -> int:
    return int(np.frombuffer(bytes_, dtype=np.uint8).ctypes.data)
