"""The simulator's end of the camera stream against the daemon's own end, over a real socket."""

import asyncio
from collections.abc import Coroutine
from contextlib import suppress

import cv2
import numpy as np
import pytest

from sitl.frame_server import FrameServer
from sitl.processes import FlightError
from vcl_companion.cameras.source import Frame
from vcl_companion.cameras.stream import Answer, StreamCamera, encode_answer
from vcl_companion.clock import ManualClock

IMAGE = np.arange(48, dtype=np.uint8).reshape(6, 8) * 5


def png(image: np.ndarray[tuple[int, int], np.dtype[np.uint8]] = IMAGE) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def soon(work: Coroutine[None, None, None]) -> None:
    async def bounded() -> None:
        async with asyncio.timeout(10.0):
            await work

    asyncio.run(bounded())


def test_frames_arrive_with_their_time_and_every_answer_comes_back() -> None:
    async def work() -> None:
        server, clock = FrameServer("mav0"), ManualClock()
        camera = StreamCamera("127.0.0.1", await server.start(), (8, 6), clock)
        seen: list[Frame] = []

        async def daemon() -> None:
            async for frame in camera.frames():
                seen.append(frame)
                camera.done(frame.sequence, "refused" if frame.sequence == 1 else "localized")

        task = asyncio.ensure_future(daemon())
        await server.connected()
        server.tell_time(5)
        server.give(0, 100, png())
        server.give(1, 200, png(255 - IMAGE))
        await server.answered()
        assert server.outcomes == {0: "localized", 1: "refused"}
        server.tell_time(300)
        server.say_end(400)
        await task
        assert [(f.sequence, f.captured_at_ns) for f in seen] == [(0, 100), (1, 200)]
        assert np.array_equal(seen[1].image, 255 - IMAGE)
        assert clock.now_ns() == 400
        await camera.close()
        await server.close()

    soon(work())


def test_a_daemon_that_hangs_up_is_told_from_one_that_is_slow() -> None:
    async def work() -> None:
        server = FrameServer("mav1")
        camera = StreamCamera("127.0.0.1", await server.start(), (8, 6), ManualClock())
        frames = camera.frames()
        first = asyncio.ensure_future(anext(frames))
        await server.connected()
        server.give(0, 100, png())
        await first
        assert server.unanswered() == [0]
        await camera.close()
        with pytest.raises(FlightError, match="daemon of mav1 closed its camera stream"):
            await server.answered()
        with pytest.raises(FlightError, match="closed"):
            server.give(1, 200, png())
        await server.close()

    soon(work())


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        (encode_answer(Answer(7, "localized")), "answers frame 7"),
        (encode_answer(Answer(0, "localized")) * 2, "answers frame 0"),
        (encode_answer(Answer(0, "idle")), "answers question 0"),
        (b"HTTP/1.1 200 OK\r\n", "not an answer"),
    ],
)
def test_answers_that_cannot_be_are_refused(answers: bytes, message: str) -> None:
    async def work() -> None:
        server = FrameServer("mav0")
        reader, writer = await asyncio.open_connection("127.0.0.1", await server.start())
        await server.connected()
        server.give(0, 100, png())
        server.give(1, 200, png())
        writer.write(answers)
        with pytest.raises(FlightError, match=message):
            await server.answered()
        writer.close()
        with suppress(OSError):
            await reader.read()
        await server.close()

    soon(work())


def test_a_daemon_is_asked_whether_it_is_busy_and_one_that_hangs_up_is_not_waited_for() -> None:
    async def work() -> None:
        server, clock = FrameServer("mav0"), ManualClock()
        camera = StreamCamera("127.0.0.1", await server.start(), (8, 6), clock)
        frames = camera.frames()
        first = asyncio.ensure_future(anext(frames))
        await server.connected()
        server.give(0, 100, png())
        await first
        following = asyncio.ensure_future(anext(frames))
        assert not await server.is_busy()
        camera.is_busy = lambda: True
        assert all(await asyncio.gather(server.is_busy(), server.is_busy()))
        assert clock.now_ns() == 100
        assert server.unanswered() == [0]
        await camera.close()
        with pytest.raises(FlightError, match="closed its camera stream"):
            await server.is_busy()
        with pytest.raises(StopAsyncIteration):
            await following
        await server.close()

    soon(work())


def test_a_camera_has_one_owner() -> None:
    async def work() -> None:
        server = FrameServer("mav0")
        port = await server.start()
        _, owner = await asyncio.open_connection("127.0.0.1", port)
        await server.connected()
        reader, second = await asyncio.open_connection("127.0.0.1", port)
        with suppress(ConnectionResetError):
            assert await reader.read() == b""
        server.give(0, 100, png())
        owner.write(encode_answer(Answer(0, "dropped")))
        await server.answered()
        assert server.outcomes == {0: "dropped"}
        owner.close()
        second.close()
        await server.close()

    soon(work())


def test_nothing_is_given_before_anyone_listens() -> None:
    with pytest.raises(FlightError, match="mav0 is not connected"):
        FrameServer("mav0").give(0, 0, png())
