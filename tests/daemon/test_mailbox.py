"""Where frames and requests wait: the newest one, and one only."""

from __future__ import annotations

import asyncio

import numpy as np

from tests.daemon.waiting import run
from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.mailbox import Mailbox, PeerMailbox


def frame(sequence: int) -> Frame:
    return Frame(np.zeros((2, 3), np.uint8), sequence, sequence, 0)


def test_the_newest_wins_and_the_replaced_one_comes_back() -> None:
    async def scenario() -> None:
        mailbox, frames = Mailbox(), [frame(k) for k in range(3)]
        assert mailbox.put(frames[0]) is None
        assert mailbox.put(frames[1]) is frames[0]
        assert mailbox.put(frames[2]) is frames[1]
        assert await mailbox.take() is frames[2]
        assert mailbox.put(frames[0]) is None

    run(scenario())


def test_who_comes_first_waits_for_the_frame() -> None:
    async def scenario() -> None:
        mailbox, coming = Mailbox(), frame(0)
        watcher = asyncio.create_task(mailbox.filled())
        await asyncio.sleep(0)
        assert not watcher.done()
        mailbox.put(coming)
        await watcher
        assert await mailbox.take() is coming
        taker = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        assert not taker.done()
        mailbox.put(coming)
        assert await taker is coming

    run(scenario())


def test_filled_leaves_the_frame_and_waits_again_once_it_is_taken() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        mailbox.put(frame(0))
        await mailbox.filled()
        await mailbox.filled()
        assert (await mailbox.take()).sequence == 0
        again = asyncio.create_task(mailbox.filled())
        await asyncio.sleep(0)
        assert not again.done()
        again.cancel()

    run(scenario())


def test_of_two_takers_one_gets_the_frame_and_the_other_the_next() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        takers = [asyncio.create_task(mailbox.take()) for _ in range(2)]
        await asyncio.sleep(0)
        mailbox.put(frame(0))
        done, waiting = await asyncio.wait(takers, return_when=asyncio.FIRST_COMPLETED)
        assert [task.result().sequence for task in done] == [0]
        mailbox.put(frame(1))
        assert [(await task).sequence for task in waiting] == [1]

    run(scenario())


def test_a_taker_that_is_cancelled_takes_nothing() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        taker = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        mailbox.put(frame(0))
        taker.cancel()
        await asyncio.wait({taker})
        assert taker.cancelled()
        assert (await mailbox.take()).sequence == 0

    run(scenario())


def test_of_each_peer_the_newest_waits_and_peers_take_turns() -> None:
    async def scenario() -> None:
        mailbox: PeerMailbox[str] = PeerMailbox()
        waiting = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        mailbox.put(7, "first")
        assert await waiting == (7, "first")
        for k in range(1000):
            mailbox.put(7, f"flood {k}")
        mailbox.put(3, "modest")
        assert await mailbox.take() == (7, "flood 999")
        mailbox.put(7, "more")
        assert await mailbox.take() == (3, "modest")
        assert await mailbox.take() == (7, "more")

    run(scenario())
