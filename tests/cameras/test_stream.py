import asyncio
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vcl_companion.cameras.source import Frame
from vcl_companion.cameras.stream import (
    Answer,
    Record,
    StreamCamera,
    StreamEnd,
    StreamFrame,
    StreamQuestion,
    StreamTime,
    Word,
    decode_image,
    encode_answer,
    encode_record,
    read_answer,
    read_record,
)
from vcl_companion.clock import ManualClock, SystemClock
from vcl_companion.errors import DeviceError, WireError
from vcl_companion.recording.images import MAX_IMAGE_BYTES

SIZE_PX = (32, 24)
INSTANTS = st.integers(0, 2**63 - 1)
SEQUENCES = st.integers(0, 2**64 - 1)
RECORDS: st.SearchStrategy[Record] = st.one_of(
    st.builds(StreamFrame, SEQUENCES, INSTANTS, st.binary(min_size=1, max_size=64)),
    st.builds(StreamTime, INSTANTS),
    st.builds(StreamEnd, INSTANTS),
    st.builds(StreamQuestion, SEQUENCES, INSTANTS),
)
WORDS: st.SearchStrategy[Word] = st.sampled_from(
    ("localized", "refused", "dropped", "idle", "busy")
)


def reader_of(data: bytes) -> asyncio.StreamReader:
    reader = asyncio.StreamReader()
    reader.feed_data(data)
    reader.feed_eof()
    return reader


def parsed(data: bytes) -> Record:
    async def read() -> Record:
        return await read_record(reader_of(data))

    return asyncio.run(read())


def answered(data: bytes) -> Answer | None:
    async def read() -> Answer | None:
        return await read_answer(reader_of(data))

    return asyncio.run(read())


def picture(level: int, size_px: tuple[int, int] = SIZE_PX) -> NDArray[np.uint8]:
    rng = np.random.default_rng(level)
    return rng.integers(0, 256, size_px[::-1], dtype=np.uint8)


def png(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


@given(RECORDS)
def test_record_round_trip(record: Record) -> None:
    assert parsed(encode_record(record)) == record


@given(SEQUENCES, WORDS)
def test_answer_round_trip(sequence: int, word: Word) -> None:
    assert answered(encode_answer(Answer(sequence, word))) == Answer(sequence, word)


def test_golden_bytes() -> None:
    assert encode_record(StreamFrame(7, 0x0102030405, b"xyz")).hex() == (
        "56434c4601010000070000000000000005040302010000000300000078797a"
    )
    assert encode_record(StreamTime(258)).hex() == (
        "56434c46010200000000000000000000020100000000000000000000"
    )
    assert encode_record(StreamEnd(3)).hex() == (
        "56434c46010300000000000000000000030000000000000000000000"
    )
    assert encode_record(StreamQuestion(5, 3)).hex() == (
        "56434c46010400000500000000000000030000000000000000000000"
    )
    assert encode_answer(Answer(9, "dropped")).hex() == "56434c4101030000" + "09" + "00" * 7
    assert encode_answer(Answer(9, "busy")).hex() == "56434c4101050000" + "09" + "00" * 7


@given(st.binary(max_size=80))
def test_any_bytes_are_a_record_or_a_wire_error(data: bytes) -> None:
    for read in (parsed, answered):
        try:
            read(data)
        except WireError:
            continue


@given(RECORDS, st.integers(0, 27), st.integers(1, 255))
def test_a_flipped_header_byte_never_breaks_out(record: Record, at: int, flip: int) -> None:
    data = bytearray(encode_record(record))
    data[at] ^= flip
    with suppress(WireError):
        assert parsed(bytes(data)) != record


def test_a_length_that_lies_is_refused_before_it_is_read() -> None:
    header = struct.pack("<4sBBHQQI", b"VCLF", 1, 1, 0, 1, 1, MAX_IMAGE_BYTES + 1)
    with pytest.raises(WireError, match=f"frame 1 claims {MAX_IMAGE_BYTES + 1} bytes"):
        parsed(header)


def test_numbers_that_do_not_fit_are_not_sent() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode_record(StreamFrame(0, 1, b""))
    with pytest.raises(ValueError, match="does not fit"):
        encode_record(StreamTime(2**63))
    with pytest.raises(ValueError, match="does not fit"):
        encode_record(StreamQuestion(2**64, 1))


def test_answers_end_between_answers_only() -> None:
    data = encode_answer(Answer(1, "refused"))
    assert answered(b"") is None
    with pytest.raises(WireError, match="in the middle"):
        answered(data[:-1])


def test_an_image_keeps_its_pixels() -> None:
    image = picture(1)
    assert np.array_equal(decode_image(png(image)), image)
    colour = cv2.imencode(".png", np.dstack([image] * 3))[1].tobytes()
    assert np.array_equal(decode_image(colour), image)


@given(st.binary(max_size=200))
def test_undecodable_images_are_wire_errors(data: bytes) -> None:
    with pytest.raises(WireError, match="undecodable"):
        decode_image(data)


Server = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def camera_of(
    server: Server, clock: ManualClock | SystemClock | None = None
) -> AsyncIterator[StreamCamera]:
    listening = await asyncio.start_server(server, "127.0.0.1", 0)
    port = listening.sockets[0].getsockname()[1]
    camera = StreamCamera("127.0.0.1", port, SIZE_PX, clock or ManualClock())
    try:
        yield camera
    finally:
        await camera.close()
        listening.close()
        await listening.wait_closed()


def serving(*records: Record | bytes) -> Server:
    async def server(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for record in records:
            writer.write(record if isinstance(record, bytes) else encode_record(record))
        writer.write_eof()
        await reader.read()
        writer.close()

    return server


async def all_frames(camera: StreamCamera) -> list[Frame]:
    return [frame async for frame in camera.frames()]


def test_frames_move_the_clock_before_they_are_handed_out() -> None:
    async def scenario() -> None:
        clock = ManualClock()
        records: list[Record] = [
            StreamTime(90),
            StreamFrame(0, 100, png(picture(0))),
            StreamTime(150),
            StreamFrame(2, 200, png(picture(2))),
            StreamEnd(250),
        ]
        before_ns = time.monotonic_ns()
        async with camera_of(serving(*records), clock) as camera:
            seen = []
            async for frame in camera.frames():
                assert clock.now_ns() == frame.captured_at_ns
                assert before_ns <= frame.received_at_ns <= time.monotonic_ns()
                assert np.array_equal(frame.image, picture(frame.sequence))
                assert not frame.image.flags.writeable
                seen.append((frame.sequence, frame.captured_at_ns))
            assert seen == [(0, 100), (2, 200)]
            assert clock.now_ns() == 250

    asyncio.run(scenario())


def test_every_answer_arrives_even_when_the_daemon_hangs_up() -> None:
    answers: list[Answer] = []

    async def server(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for sequence in range(3):
            writer.write(encode_record(StreamFrame(sequence, sequence + 1, png(picture(0)))))
        writer.write(encode_record(StreamEnd(9)))
        while (answer := await read_answer(reader)) is not None:
            answers.append(answer)
        writer.close()
        complete.set()

    complete = asyncio.Event()

    async def scenario() -> None:
        async with camera_of(server) as camera:
            await all_frames(camera)
            camera.done(2, "localized")
            camera.done(0, "dropped")
            camera.done(1, "refused")
            for sequence in (1, 7):
                with pytest.raises(ValueError, match="not waiting for an answer"):
                    camera.done(sequence, "refused")
            await camera.close()
            await complete.wait()

    asyncio.run(scenario())
    assert answers == [Answer(2, "localized"), Answer(0, "dropped"), Answer(1, "refused")]


@pytest.mark.parametrize(
    ("records", "why"),
    [
        ([], "ended without an end record"),
        ([b"GET / HTTP/1.1\r\n" * 2], "not a record of this protocol"),
        (
            [StreamFrame(0, 1, png(picture(0, (16, 8))))],
            "frame 0 is 16x8, the calibration says 32x24",
        ),
        (
            [StreamFrame(4, 1, png(picture(0))), StreamFrame(4, 2, png(picture(0)))],
            "frame 4 does not follow frame 4",
        ),
        (
            [StreamFrame(4, 1, png(picture(0))), StreamFrame(5, 1, png(picture(0)))],
            "frame 5 does not follow frame 4",
        ),
    ],
)
def test_a_broken_stream_is_one_clear_line(records: list[Record | bytes], why: str) -> None:
    async def scenario() -> None:
        async with camera_of(serving(*records), SystemClock()) as camera:
            await all_frames(camera)

    with pytest.raises(DeviceError, match=rf"^camera stream 127\.0\.0\.1:\d+: {why}") as caught:
        asyncio.run(scenario())
    assert "\n" not in str(caught.value)


def test_an_image_that_cannot_be_decoded_is_refused_and_left_out(
    caplog: pytest.LogCaptureFixture,
) -> None:
    images = [png(picture(0)), b"nonsense", png(picture(2))]
    records = [StreamFrame(k, k + 1, data) for k, data in enumerate(images)]

    left_out: list[tuple[int, int]] = []

    async def scenario() -> list[int]:
        async with camera_of(serving(*records, StreamEnd(4)), SystemClock()) as camera:
            camera.left_out = lambda sequence, at_ns: left_out.append((sequence, at_ns))
            return [frame.sequence for frame in await all_frames(camera)]

    assert asyncio.run(scenario()) == [0, 2]
    assert left_out == [(1, 2)]
    assert "frame 1 is left out: undecodable image of 8 bytes" in caplog.text


def test_closing_ends_the_frames_without_an_error() -> None:
    async def scenario() -> None:
        async with camera_of(serving_without_end) as camera:
            frames = camera.frames()
            await anext(frames)
            waiting = asyncio.ensure_future(anext(frames, None))
            await asyncio.sleep(0)
            await camera.close()
            assert await waiting is None

    async def serving_without_end(
        reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        writer.write(encode_record(StreamFrame(0, 1, png(picture(0)))))
        await reader.read()
        writer.close()

    asyncio.run(scenario())


def test_nobody_there_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vcl_companion.cameras.stream._CONNECT_WITHIN_S", 0.05)

    async def scenario() -> None:
        listening = await asyncio.start_server(serving(), "127.0.0.1", 0)
        port = listening.sockets[0].getsockname()[1]
        listening.close()
        await listening.wait_closed()
        await all_frames(StreamCamera("127.0.0.1", port, SIZE_PX, ManualClock()))

    with pytest.raises(DeviceError, match=r"no connection within .*Connect call failed|refused"):
        asyncio.run(scenario())
