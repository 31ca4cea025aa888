"""Frames over a byte stream: the simulator serves, the daemon connects and answers each one.

Both directions live here, so that the simulator and the daemon share one table
(little endian, no padding):

==========  ======  =====================================================
to daemon           ``<4sBBHQQI`` then payload
magic       4s      ``VCLF``
version     u8      1
kind        u8      1 frame, 2 time (the clock moves on), 3 end, 4 question
reserved    u16     0
sequence    u64     of the frame; 0 for kinds 2 and 3; any number for 4
at_ns       u64     mid-exposure of the frame; the time; below 2**63
length      u32     payload bytes, at most 16 MiB; 0 for kinds 2 to 4
payload     bytes   the image as PNG, JPEG or WebP
==========  ======  =====================================================

============  ======  ==============================================
from daemon           ``<4sBBHQ``
magic         4s      ``VCLA``
version       u8      1
outcome       u8      of a frame: 1 localized, 2 refused, 3 dropped;
                      to a question, whether a map is being made or
                      on its way: 4 no, 5 yes
reserved      u16     0
sequence      u64     of the frame or the question that this answers
============  ======  ==============================================
"""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.cameras.source import Frame, Outcome
from vcl_companion.clock import Clock, ManualClock
from vcl_companion.errors import DeviceError, WireError
from vcl_companion.recording.images import MAX_IMAGE_BYTES

_RECORD = struct.Struct("<4sBBHQQI")
_ANSWER = struct.Struct("<4sBBHQ")
_RECORD_MAGIC, _ANSWER_MAGIC, _VERSION = b"VCLF", b"VCLA", 1
_FRAME, _TIME, _END, _QUESTION = 1, 2, 3, 4
Word = Outcome | Literal["idle", "busy"]
_CODES: dict[Word, int] = {"localized": 1, "refused": 2, "dropped": 3, "idle": 4, "busy": 5}
_WORDS = {code: outcome for outcome, code in _CODES.items()}
_END_OF_TIME_NS = 2**63

_log = logging.getLogger(__name__)

_CONNECT_WITHIN_S = 10.0
_RETRY_AFTER_S = 0.1


@dataclass(frozen=True)
class StreamFrame:
    """An encoded image on its way to the daemon."""

    sequence: int
    at_ns: int
    encoded: bytes


@dataclass(frozen=True)
class StreamTime:
    """The recording's time has moved on to ``at_ns``."""

    at_ns: int


@dataclass(frozen=True)
class StreamEnd:
    """No frame follows; ``at_ns`` is the last instant."""

    at_ns: int


@dataclass(frozen=True)
class StreamQuestion:
    """Whether a map is being made or on its way, while time stands at ``at_ns``."""

    sequence: int
    at_ns: int


@dataclass(frozen=True)
class Answer:
    """What became of the frame numbered ``sequence``, or the answer to that question."""

    sequence: int
    outcome: Word


Record = StreamFrame | StreamTime | StreamEnd | StreamQuestion


def encode_record(record: Record) -> bytes:
    """Return the bytes of a record to the daemon.

    Raises:
        ValueError: a number does not fit its field.
    """
    if not 0 <= record.at_ns < _END_OF_TIME_NS:
        raise ValueError(f"at_ns does not fit: {record.at_ns}")
    match record:
        case StreamFrame(sequence, at_ns, encoded):
            if not 0 < len(encoded) <= MAX_IMAGE_BYTES or not 0 <= sequence < 2**64:
                raise ValueError(f"frame {sequence} of {len(encoded)} bytes does not fit")
            return _header(_FRAME, sequence, at_ns, len(encoded)) + encoded
        case StreamTime(at_ns):
            return _header(_TIME, 0, at_ns, 0)
        case StreamEnd(at_ns):
            return _header(_END, 0, at_ns, 0)
        case StreamQuestion(sequence, at_ns):
            if not 0 <= sequence < 2**64:
                raise ValueError(f"question {sequence} does not fit")
            return _header(_QUESTION, sequence, at_ns, 0)


def _header(kind: int, sequence: int, at_ns: int, length: int) -> bytes:
    return _RECORD.pack(_RECORD_MAGIC, _VERSION, kind, 0, sequence, at_ns, length)


async def read_record(reader: asyncio.StreamReader) -> Record:
    """Return the next record from the simulator.

    Raises:
        WireError: the bytes are no record, or they stop before one is complete.
    """
    try:
        header = await reader.readexactly(_RECORD.size)
        magic, version, kind, reserved, sequence, at_ns, length = _RECORD.unpack(header)
        if (magic, version, reserved) != (_RECORD_MAGIC, _VERSION, 0):
            raise WireError(f"not a record of this protocol: {header[:8]!r}")
        if at_ns >= _END_OF_TIME_NS:
            raise WireError(f"time {at_ns} ns is out of range")
        if kind == _FRAME:
            if not 0 < length <= MAX_IMAGE_BYTES:
                raise WireError(f"frame {sequence} claims {length} bytes")
            return StreamFrame(sequence, at_ns, await reader.readexactly(length))
    except asyncio.IncompleteReadError as cut:
        raise WireError("ended without an end record") from cut
    if kind == _QUESTION and length == 0:
        return StreamQuestion(sequence, at_ns)
    if (sequence, length) != (0, 0) or kind not in (_TIME, _END):
        raise WireError(f"no such record: kind {kind}, sequence {sequence}, {length} bytes")
    return StreamTime(at_ns) if kind == _TIME else StreamEnd(at_ns)


def encode_answer(answer: Answer) -> bytes:
    """Return the bytes of an answer to the simulator."""
    return _ANSWER.pack(_ANSWER_MAGIC, _VERSION, _CODES[answer.outcome], 0, answer.sequence)


async def read_answer(reader: asyncio.StreamReader) -> Answer | None:
    """Return the daemon's next answer, None when it closed the connection between answers.

    Raises:
        WireError: the bytes are no answer, or they stop in the middle of one.
    """
    try:
        data = await reader.readexactly(_ANSWER.size)
    except asyncio.IncompleteReadError as cut:
        if cut.partial:
            raise WireError("ended in the middle of an answer") from cut
        return None
    magic, version, code, reserved, sequence = _ANSWER.unpack(data)
    outcome = _WORDS.get(code)
    if (magic, version, reserved) != (_ANSWER_MAGIC, _VERSION, 0) or outcome is None:
        raise WireError(f"not an answer of this protocol: {data!r}")
    return Answer(sequence, outcome)


def decode_image(encoded: bytes) -> NDArray[np.uint8]:
    """Return the (H, W) grey image of PNG, JPEG or WebP bytes, pixels as stored.

    An EXIF orientation is not applied: it would turn the pixels away from the
    calibration.

    Raises:
        WireError: the bytes are no image.
    """
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(encoded, dtype=np.uint8), flags)
    except cv2.error as error:
        raise WireError(f"undecodable image of {len(encoded)} bytes") from error
    if image is None:
        raise WireError(f"undecodable image of {len(encoded)} bytes")
    return np.asarray(image, dtype=np.uint8)


class StreamCamera:
    """The daemon's end of the stream.

    With a ``ManualClock`` the stream is the time: each record moves the clock
    before anything else is done with it. With another clock the sender stamps
    on that clock itself.
    """

    def __init__(self, host: str, port: int, size_px: tuple[int, int], clock: Clock) -> None:
        """Keep where to connect, and the (width, height) that frames must have."""
        self._host, self._port, self._size_px, self._clock = host, port, size_px, clock
        self._writer: asyncio.StreamWriter | None = None
        self._unanswered: set[int] = set()
        self._closed = False
        self.is_busy: Callable[[], bool] = lambda: False
        """What a question is answered by."""
        self.left_out: Callable[[int, int], None] = lambda _sequence, _at_ns: None
        """Is told of a frame whose image cannot be decoded; it is answered, and never yielded."""

    async def frames(self) -> AsyncIterator[Frame]:
        """Connect and yield until the end record; see ``CameraSource``."""
        reader, self._writer = await self._connect()
        sequence, at_ns = -1, -1
        try:
            while not isinstance(record := await read_record(reader), StreamEnd):
                received_at_ns = time.monotonic_ns()
                self._tell_clock(record.at_ns)
                if isinstance(record, StreamTime):
                    continue
                if isinstance(record, StreamQuestion):
                    self._say(record.sequence, "busy" if self.is_busy() else "idle")
                    continue
                if record.sequence <= sequence or record.at_ns <= at_ns:
                    raise WireError(f"frame {record.sequence} does not follow frame {sequence}")
                sequence, at_ns = record.sequence, record.at_ns
                # Beside the loop: a large PNG takes tens of milliseconds, a heartbeat cannot wait.
                try:
                    image = await asyncio.to_thread(decode_image, record.encoded)
                except WireError as error:
                    _log.warning("frame %d is left out: %s", sequence, error)
                    self.left_out(sequence, at_ns)
                    self._say(sequence, "refused")
                    continue
                if image.shape[::-1] != self._size_px:
                    raise WireError(
                        f"frame {sequence} is {image.shape[1]}x{image.shape[0]}, "
                        f"the calibration says {self._size_px[0]}x{self._size_px[1]}"
                    )
                self._unanswered.add(sequence)
                yield Frame(image, at_ns, sequence, received_at_ns)
            self._tell_clock(record.at_ns)
        except (WireError, OSError) as error:
            if self._closed:
                return
            raise DeviceError(f"camera stream {self._host}:{self._port}: {error}") from error

    def done(self, sequence: int, outcome: Outcome) -> None:
        """Send the answer; see ``CameraSource``.

        Raises:
            ValueError: that frame was not yielded, or has been answered.
        """
        if sequence not in self._unanswered:
            raise ValueError(f"frame {sequence} is not waiting for an answer")
        self._unanswered.remove(sequence)
        self._say(sequence, outcome)

    async def close(self) -> None:
        """Send what is still to be sent and hang up."""
        self._closed = True
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()

    def _say(self, sequence: int, word: Word) -> None:
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(encode_answer(Answer(sequence, word)))

    def _tell_clock(self, at_ns: int) -> None:
        if isinstance(self._clock, ManualClock):
            self._clock.advance_to(at_ns)

    async def _connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        """Connect, again and again for a while: the simulator may start after us."""
        failure: OSError | None = None
        try:
            async with asyncio.timeout(_CONNECT_WITHIN_S):
                while True:
                    try:
                        return await asyncio.open_connection(self._host, self._port)
                    except OSError as error:
                        failure = error
                    await asyncio.sleep(_RETRY_AFTER_S)
        except TimeoutError:
            why = failure.strerror or str(failure) if failure else "no answer"
            raise DeviceError(
                f"camera stream {self._host}:{self._port}: no connection within "
                f"{_CONNECT_WITHIN_S:.0f} s ({why})"
            ) from failure
