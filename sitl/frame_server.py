"""One drone's camera, seen from the simulator: serves frames, collects the answers.

The protocol is ``vcl_companion.cameras.stream``'s; this is its other end.
"""

from __future__ import annotations

import asyncio

from sitl.processes import FlightError
from vcl_companion.cameras.source import Outcome
from vcl_companion.cameras.stream import (
    Answer,
    Record,
    StreamEnd,
    StreamFrame,
    StreamQuestion,
    StreamTime,
    encode_record,
    read_answer,
)
from vcl_companion.errors import WireError

# A daemon reads its camera without pause; this much unread means that it does not.
_MAX_UNREAD_BYTES = 32 * 1024 * 1024


class FrameServer:
    """Serves one connection on 127.0.0.1; the daemon is the client.

    Attributes:
        drone: whose camera this is.
        outcomes: sequence to what the daemon said became of that frame.
        given: sequences of the frames handed out so far, but for those that a daemon had in
            hand when it was killed.
    """

    def __init__(self, drone: str) -> None:
        self.drone = drone
        self.outcomes: dict[int, Outcome] = {}
        self.given: list[int] = []
        self._open: set[int] = set()
        self._n_asked = 0
        self._at_ns = 0
        self._asked: dict[int, asyncio.Future[bool]] = {}
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._changed = asyncio.Condition()
        self._failure: str | None = None

    async def start(self) -> int:
        """Listen and return the port."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        port: int = self._server.sockets[0].getsockname()[1]
        return port

    @property
    def is_connected(self) -> bool:
        """Whether a daemon has connected, and was not killed since."""
        return self._writer is not None

    @property
    def n_given(self) -> int:
        """How many frames were handed out so far."""
        return len(self.given)

    async def connected(self) -> None:
        """Wait until the daemon has connected."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.is_connected)

    def give(self, sequence: int, at_ns: int, image_bytes: bytes) -> None:
        """Hand out one frame: an encoded image, byte for byte.

        Raises:
            FlightError: the daemon hung up, or does not read what it is given.
        """
        self._at_ns = at_ns
        self._send(StreamFrame(sequence, at_ns, image_bytes))
        self.given.append(sequence)
        self._open.add(sequence)

    def tell_time(self, at_ns: int) -> None:
        """Move the daemon's clock on."""
        self._at_ns = at_ns
        self._send(StreamTime(at_ns))

    async def is_busy(self) -> bool:
        """Ask the daemon whether a map is being made or on its way, and wait for its answer.

        Raises:
            FlightError: the daemon hung up or broke the protocol before.
        """
        self._n_asked += 1
        answer: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self._asked[self._n_asked] = answer
        self._send(StreamQuestion(self._n_asked, self._at_ns))
        return await answer

    def say_end(self, at_ns: int) -> None:
        """Say that no frame follows."""
        self._send(StreamEnd(at_ns))

    async def answered(self) -> None:
        """Wait until every frame handed out so far has been answered.

        Raises:
            FlightError: the daemon hung up or broke the protocol before.
        """
        async with self._changed:
            await self._changed.wait_for(lambda: self._failure is not None or not self._open)
        if self._open:
            raise FlightError(self._failure or "")

    def unanswered(self) -> list[int]:
        """Return the frames handed out that no answer has come for."""
        return sorted(self._open)

    async def was_killed(self) -> None:
        """Read the last answers of a daemon that was killed; then another may connect.

        What it has not answered, nobody will.
        """
        async with self._changed:
            await self._changed.wait_for(lambda: self._writer is None or self._failure is not None)
        self.given = [sequence for sequence in self.given if sequence not in self._open]
        self._open.clear()
        self._writer = self._failure = None

    async def close(self) -> None:
        """Hang up and stop listening."""
        if self._server is not None:
            self._server.close()
        if self._writer is not None:
            self._writer.transport.abort()

    def _send(self, record: Record) -> None:
        if self._writer is None or self._failure is not None:
            raise FlightError(self._failure or f"daemon of {self.drone} is not connected")
        if self._writer.transport.get_write_buffer_size() > _MAX_UNREAD_BYTES:
            raise FlightError(f"daemon of {self.drone} does not read its camera stream")
        self._writer.write(encode_record(record))

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._writer is not None:
            # A camera has one owner; a second connection is a bug worth seeing in its log.
            writer.transport.abort()
            return
        async with self._changed:
            self._writer = writer
            self._changed.notify_all()
        failure = f"daemon of {self.drone} closed its camera stream"
        try:
            while (answer := await read_answer(reader)) is not None:
                await self._take(answer)
        except (WireError, OSError) as error:
            failure = f"daemon of {self.drone}, camera stream: {error}"
        except asyncio.CancelledError:
            # Python 3.11 prints a traceback for a task of a server that ends as cancelled.
            failure = "the flight was ended"
        finally:
            async with self._changed:
                self._failure = failure
                self._changed.notify_all()
            for asked in self._asked.values():
                if not asked.done():
                    asked.set_exception(FlightError(failure))
            self._asked.clear()
            writer.transport.abort()

    async def _take(self, answer: Answer) -> None:
        number, word = answer.sequence, answer.outcome
        async with self._changed:
            match word:
                case "busy" | "idle" if number in self._asked:
                    answer_to = self._asked.pop(number)
                    if not answer_to.done():
                        answer_to.set_result(word == "busy")
                case "localized" | "refused" | "dropped" if number in self._open:
                    self._open.remove(number)
                    self.outcomes[number] = word
                case _:
                    what = "question" if word in ("busy", "idle") else "frame"
                    raise WireError(f"answers {what} {number}, which is not waiting for one")
            self._changed.notify_all()
