"""How the service is, as an autopilot, a service manager and the flight log hear it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import socket
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from tests.daemon.autopilot import Autopilot, autopilot_and_link
from tests.daemon.waiting import beside, hurry, run
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.health import Health

STALLED = re.compile("VCL no frame was answered for [67] s")
STANDBY, ACTIVE, CRITICAL = 3, 4, 5
NOW_NS = 1_700_000_000_000_000_000


class Manager:
    """A service manager that listens, as a real datagram socket."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._socket.setblocking(False)

    async def next(self) -> str:
        data = await asyncio.get_running_loop().sock_recv(self._socket, 1000)
        return data.decode()

    def all(self) -> list[str]:
        """What has come so far."""
        said = []
        with contextlib.suppress(BlockingIOError):
            while True:
                said.append(self._socket.recv(1000).decode())
        return said

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    listening = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    yield listening
    listening.close()


@contextlib.asynccontextmanager
async def healthy(path: Path) -> AsyncIterator[tuple[Health, Autopilot]]:
    """A service on a real link, its autopilot, and its log in ``path``; health does not run."""
    clock = ManualClock(NOW_NS)
    async with autopilot_and_link(1, clock, NOW_NS) as (autopilot, link):
        log = FlightLog(str(path / "flight.jsonl"), clock)
        with contextlib.closing(log):
            async with beside(link.run()):
                assert await autopilot.states.get() == 1  # it has introduced itself
                yield Health(link, log), autopilot


def events(path: Path) -> list[tuple[str, str]]:
    lines = map(json.loads, (path / "flight.jsonl").read_text().splitlines())
    return [(line["event"], line["reason"]) for line in lines if line["kind"] == "event"]


async def beats(autopilot: Autopilot) -> int:
    """The state that the next heartbeat says."""
    while not autopilot.states.empty():
        autopilot.states.get_nowait()
    hurry(1.0)
    return await autopilot.states.get()


def test_a_flight_from_start_to_fix_to_loss_and_back(tmp_path: Path, manager: Manager) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot):
            with health.waiting_for_map():
                assert await autopilot.texts.get() == "VCL waiting for a map"
            assert await beats(autopilot) == STANDBY
            health.refused("no map: none yet")
            health.localized()
            assert await autopilot.texts.get() == "VCL localized"
            assert await beats(autopilot) == ACTIVE
            health.localized()
            health.refused("a hiccup")
            hurry(1.1)
            health.refused("fog")
            assert await autopilot.texts.get() == "VCL lost: fog"
            assert await beats(autopilot) == CRITICAL
            health.localized()
            assert await autopilot.texts.get() == "VCL localized"
            assert await beats(autopilot) == ACTIVE
            assert autopilot.texts.empty()

    run(scenario())
    found = [("waiting", "waiting for a map"), ("found", "localized"), ("lost", "lost: fog")]
    assert events(tmp_path) == [*found, ("found", "localized")]
    assert manager.all() == [f"STATUS={reason}" for _, reason in events(tmp_path)]


def test_the_same_reason_is_said_once_and_another_one_not_too_often(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot):
            for n in range(100):  # only the number changes
                health.refused(f"{n} landmarks agree, 15 needed")
                hurry(0.2)
            for k in range(100):  # two reasons in turn, 5 times a second
                health.refused("fog" if k % 2 else "night")
                hurry(0.2)
            health.localized()
            said = []
            while "VCL localized" not in said:
                said.append(await autopilot.texts.get())
            assert said[0] == "VCL waiting: 0 landmarks agree, 15 needed"
            turns = said[1:-1]
            assert set(turns) <= {"VCL waiting: fog", "VCL waiting: night"}
            assert 3 <= len(turns) <= 4  # 20 s, at most one in 5 s
            assert all("landmarks" not in text for text in turns)

    run(scenario())


def test_who_lives_on_peers_alone_says_so_but_not_at_every_change(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot):
            health.localized(by_peers=True)
            for k in range(100):  # in turn, 5 times a second, for 20 s
                health.localized(by_peers=k % 2 == 0)
                hurry(0.2)
            said = [await autopilot.texts.get() for _ in range(4)]
            assert said[0] == "VCL localized by peers alone"
            assert set(said[1:]) <= {"VCL localized", "VCL localized by peers alone"}
            assert await beats(autopilot) == ACTIVE
            assert autopilot.texts.qsize() <= 1

    run(scenario())


def test_the_watchdog_is_fed_only_while_frames_are_answered(
    tmp_path: Path, manager: Manager
) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot), beside(health.run()):
            assert await manager.next() == "WATCHDOG=1"  # before the first frame
            health.localized()
            assert await autopilot.texts.get() == "VCL localized"
            hurry(0.5)
            assert "WATCHDOG=1" in [await manager.next(), await manager.next()]
            hurry(6.0)
            assert STALLED.fullmatch(await autopilot.texts.get())
            manager.all()
            while not autopilot.states.empty():
                autopilot.states.get_nowait()
            for _ in range(5):  # many checks and heartbeats are due, and none comes
                hurry(3.0)
                await asyncio.sleep(0)
                await asyncio.sleep(0)
            assert manager.all() == []
            health.localized()
            # What was sent before this would have come before it.
            assert await autopilot.texts.get() == "VCL localized"
            assert autopilot.states.empty()
            assert await beats(autopilot) == ACTIVE
            assert await manager.next() == "STATUS=localized"
            hurry(0.5)
            assert await manager.next() == "WATCHDOG=1"

    run(scenario())
    assert [event for event, _ in events(tmp_path)] == ["found", "stalled", "found"]


def test_waiting_for_a_map_is_no_stall_but_what_follows_may_be(
    tmp_path: Path, manager: Manager
) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot), beside(health.run()):
            with health.waiting_for_map():
                assert await autopilot.texts.get() == "VCL waiting for a map"
                for _ in range(5):
                    manager.all()
                    hurry(10.0)
                    assert await manager.next() == "WATCHDOG=1"
                assert autopilot.texts.empty()
            hurry(6.0)  # the map is there, and the frame hangs
            assert STALLED.fullmatch(await autopilot.texts.get())

    run(scenario())


def test_a_loss_is_not_said_before_it_has_lasted(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with healthy(tmp_path) as (health, autopilot):
            health.localized()
            for _ in range(10):  # one frame in two
                hurry(0.9)
                health.refused("fog")
                health.localized()
            health.localized()
            assert await autopilot.texts.get() == "VCL localized"
            assert await beats(autopilot) == ACTIVE
            assert autopilot.texts.empty()

    run(scenario())
    assert events(tmp_path) == [("found", "localized")]
