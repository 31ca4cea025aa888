"""The ground's orders, against companions made by hand."""

import asyncio
from collections.abc import Sequence

import pytest
from click.testing import CliRunner

from tests.links import wire
from tests.links.running import Udp, running, udp
from tests.ports import free_ports
from vcl_companion.cli import main
from vcl_companion.errors import DeviceError
from vcl_companion.ground.orders import ORDERS, Ordering, Told

UPDATE_MAP, SAVE, RELOAD, RELOCALIZE, PAUSE = range(31010, 31015)
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS, CANCELLED = range(7)


class Companion:
    """A drone's component 197, heard over a link: it answers an order as it is told to.

    Args:
        side: its socket.
        system_id: whose.
        answers: result and progress of each, a twentieth of a second apart.
        loses: so many orders do not arrive.
        command: what it is ordered.
        says: texts before its answers, as severity, text, number and chunk of each.
    """

    def __init__(
        self,
        side: Udp,
        system_id: int,
        answers: Sequence[tuple[int, int]],
        loses: int,
        command: int,
        says: Sequence[tuple[int, bytes, int, int]],
    ) -> None:
        self._command = command
        self._says = says
        self._side = side
        self._system_id = system_id
        self._answers = answers
        self._loses = loses
        self.orders: list[tuple[float, int]] = []

    async def run(self, ground: tuple[str, int]) -> None:
        while True:
            self._say(wire.heartbeat(self._system_id, 197), ground)
            try:
                async with asyncio.timeout(0.1):
                    data, _ = await self._side.got.get()
            except TimeoutError:
                continue
            for seen in wire.read(data):
                if seen.message_id == wire.COMMAND_LONG and seen.fields[8] == self._system_id:
                    assert (seen.system, seen.component) == (255, 190)
                    assert (seen.fields[7], seen.fields[9]) == (self._command, 197)
                    await self._obey(seen.fields[0], seen.fields[10], ground)

    async def _obey(self, first: float, confirmation: int, ground: tuple[str, int]) -> None:
        self.orders.append((first, confirmation))
        if len(self.orders) <= self._loses:
            return
        for text in self._says:
            said = wire.packed(wire.STATUSTEXT, *text, system=self._system_id, component=197)
            self._say(said, ground)
        is_cancel = self._command == UPDATE_MAP and first == 1.0
        answers = [(CANCELLED, 255)] if is_cancel else self._answers
        for result, progress in answers:
            answer = wire.packed(
                wire.COMMAND_ACK, self._command, result, progress, 0, 255, 190,
                system=self._system_id, component=197,
            )  # fmt: skip
            self._say(answer, ground)
            await asyncio.sleep(0.05)

    def _say(self, data: bytes, ground: tuple[str, int]) -> None:
        self._side.transport.sendto(data, ground)


async def ordered(
    *companions: tuple[int, Sequence[tuple[int, int]], int],
    drones: Sequence[int] = (),
    within_s: float = 8.0,
    order: str = "update-map",
    says: Sequence[tuple[int, bytes, int, int]] = (),
) -> tuple[bool, list[Told], list[Companion]]:
    """Give companions, each over a link of its own, an order; return what came of it."""
    told: list[Told] = []
    ports = free_ports(len(companions))
    links = [f"udpin:127.0.0.1:{port}" for port in ports]
    ordering = Ordering(ORDERS[order], links, drones, within_s, told.append)
    command = ORDERS[order].command
    async with udp() as one, udp() as two:
        sides = (one, two)[: len(companions)]
        made = [
            Companion(side, *parts, command, says)
            for side, parts in zip(sides, companions, strict=True)
        ]
        grounds = [("127.0.0.1", port) for port in ports]
        async with running(*(c.run(at) for c, at in zip(made, grounds, strict=True))):
            return await ordering.run(), told, made


def texts(told: list[Told], drone: int) -> list[str]:
    return [one.text for one in told if one.system_id == drone]


def test_all_that_are_heard_are_asked_and_followed_to_the_end() -> None:
    going = [(IN_PROGRESS, 0), (IN_PROGRESS, 20), (IN_PROGRESS, 20), (ACCEPTED, 100)]
    is_done, told, _ = asyncio.run(ordered((1, going, 0), (2, [(ACCEPTED, 100)], 0)))
    assert is_done
    assert texts(told, 1) == ["is at it, 0 %", "is at it, 20 %", "has a new map"]
    assert texts(told, 2) == ["has a new map"]
    assert [one.is_good for one in told if one.is_over] == [True, True]


@pytest.mark.parametrize(
    ("result", "text"),
    [
        (BUSY, "has no map yet, or is at another order"),
        (DENIED, "refuses"),
        (UNSUPPORTED, "does not know the command"),
        (FAILED, "no update came of it"),
    ],
)
def test_what_came_of_it_is_said(result: int, text: str) -> None:
    is_done, told, _ = asyncio.run(ordered((1, [(IN_PROGRESS, 255), (result, 255)], 0)))
    assert not is_done
    assert texts(told, 1) == ["is at it", text]


def test_an_order_that_is_lost_is_repeated_as_the_same_one() -> None:
    is_done, _, (one,) = asyncio.run(ordered((1, [(ACCEPTED, 100)], 2), drones=[1]))
    assert is_done
    assert one.orders == [(0.0, 0), (0.0, 1), (0.0, 2)]


def test_who_is_not_done_in_time_is_told_to_stop() -> None:
    is_done, told, (one,) = asyncio.run(
        ordered((1, [(IN_PROGRESS, 60)], 0), drones=[1], within_s=1.0)
    )
    assert not is_done
    assert texts(told, 1)[-1] == "is not done in time; cancelled"
    assert one.orders[0] == (0.0, 0)


@pytest.mark.parametrize(
    ("order", "command", "parameter", "text"),
    [
        ("save-map", SAVE, 0.0, "has saved its map"),
        ("forget-map", SAVE, 1.0, "begins without a map next time"),
        ("reload-map", RELOAD, 0.0, "is back on its saved map"),
        ("relocalize", RELOCALIZE, 0.0, "looks for where it is"),
        ("pause", PAUSE, 1.0, "sends no poses"),
        ("resume", PAUSE, 0.0, "sends poses again"),
    ],
)
def test_each_order_is_its_command(order: str, command: int, parameter: float, text: str) -> None:
    assert ORDERS[order].command == command
    answers = [(IN_PROGRESS, 255), (ACCEPTED, 255)]
    is_done, told, (one,) = asyncio.run(ordered((1, answers, 0), drones=[1], order=order))
    assert is_done
    assert texts(told, 1) == ["is at it", text]
    assert one.orders == [(parameter, 0)]


def test_what_cannot_be_taken_back_is_not() -> None:
    is_done, told, (one,) = asyncio.run(
        ordered((1, [(IN_PROGRESS, 255)], 0), drones=[1], within_s=1.0, order="save-map")
    )
    assert not is_done
    assert texts(told, 1)[-1] == "is not done in time"
    assert one.orders == [(0.0, 0)]


def test_why_something_is_not_done_is_passed_on_from_the_drone() -> None:
    says = [(3, b"VCL map not saved: No spa\x07ce left on dev".ljust(50, b"e"), 7, 0),
            (3, b" ice", 7, 1), (6, b"VCL localized", 0, 0)]  # fmt: skip
    is_done, told, _ = asyncio.run(
        ordered((1, [(FAILED, 255)], 0), drones=[1], order="save-map", says=says)
    )
    assert not is_done
    (text,) = texts(told, 1)
    assert text.startswith("could not save it; it says: VCL map not saved: No space left on dev")
    assert text.endswith("e ice")
    is_done, told, _ = asyncio.run(
        ordered((1, [(ACCEPTED, 255)], 0), drones=[1], order="save-map", says=says)
    )
    assert texts(told, 1) == ["has saved its map"]


def test_who_is_not_heard_is_named() -> None:
    with pytest.raises(DeviceError, match="companion of 9 is not heard"):
        asyncio.run(ordered((1, [(ACCEPTED, 100)], 0), drones=[1, 9]))


@pytest.mark.parametrize("order", ["update-map", "save-map", "pause"])
def test_nobody_there_is_one_line_and_status_2(order: str) -> None:
    (port,) = free_ports(1)
    result = CliRunner().invoke(main, ["ground", order, "--link", f"udpin:127.0.0.1:{port}"])
    assert result.exit_code == 2
    assert "the companion of any drone is not heard" in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize("within", ["nan", "0.5", "inf", "soon"])
def test_a_time_that_is_none_is_refused(within: str) -> None:
    result = CliRunner().invoke(main, ["ground", "pause", "--within", within])
    assert result.exit_code == 2
    assert "--within" in result.output


def test_what_ends_who_listens_is_not_waited_out() -> None:
    class PipeIsClosedError(Exception):
        pass

    def tell(_: Told) -> None:
        raise PipeIsClosedError

    async def scenario() -> None:
        (port,) = free_ports(1)
        link = f"udpin:127.0.0.1:{port}"
        ordering = Ordering(ORDERS["update-map"], [link], (), 60.0, tell)
        async with udp() as side:
            companion = Companion(side, 1, [(IN_PROGRESS, 0)], 0, UPDATE_MAP, ())
            async with running(companion.run(("127.0.0.1", port))), asyncio.timeout(20.0):
                with pytest.raises(PipeIsClosedError):
                    await ordering.run()
                # What was ordered is cancelled all the same.
                while [first for first, _ in companion.orders] != [0.0, 1.0]:
                    await asyncio.sleep(0.05)

    asyncio.run(scenario())


def test_a_host_that_cannot_be_is_said_to_be_none() -> None:
    ordering = Ordering(ORDERS["pause"], ["udp:192.168.1..5:14550"], (), 1.0, lambda _: None)
    with pytest.raises(DeviceError, match="is not heard"):
        asyncio.run(ordering.run())
