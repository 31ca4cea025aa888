"""Where frames and requests wait: the newest one, and one only."""

from __future__ import annotations

import asyncio

import numpy as np

from tests.daemon.waiting import hurry, run
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
        taker = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        assert not taker.done()
        mailbox.put(coming)
        assert await taker is coming

    run(scenario())


def test_who_has_a_frame_is_told_of_a_newer_one_taken_or_not() -> None:
    async def scenario() -> None:
        mailbox, frames = Mailbox(), [frame(k) for k in range(3)]
        mailbox.put(frames[0])
        assert await mailbox.take() is frames[0]
        watchers = [asyncio.create_task(mailbox.newer_than(frames[0])) for _ in range(2)]
        taker = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0)
        assert not mailbox.has_had_newer(frames[0])
        assert not any(watcher.done() for watcher in watchers)
        mailbox.put(frames[1])
        assert await taker is frames[1]
        await asyncio.gather(*watchers)
        await mailbox.newer_than(frames[0])
        assert mailbox.has_had_newer(frames[0])
        assert not mailbox.has_had_newer(frames[1])
        mailbox.put(frames[2])
        await mailbox.newer_than(frames[1])

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


def test_what_is_left_for_later_gives_way_to_what_is_newer() -> None:
    async def scenario() -> None:
        mailbox: PeerMailbox[str] = PeerMailbox()
        mailbox.put_later(7, "old", 5.0)
        mailbox.put_later(3, "slow", 5.0)
        mailbox.put(7, "new")
        assert await mailbox.take() == (7, "new")
        mailbox.put(7, "newer")
        mailbox.put_later(7, "older", 0.0)
        hurry(5.1)
        assert await mailbox.take() == (7, "newer")
        assert await mailbox.take() == (3, "slow")
        hurry(10.0)
        waiting = asyncio.create_task(mailbox.take())
        await asyncio.sleep(0.01)
        assert not waiting.done()
        waiting.cancel()

    run(scenario())
