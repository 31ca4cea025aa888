"""An autopilot's side of a link on loopback, played by hand-made MAVLink, and its companion's."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

import numpy as np

from tests.links import wire
from vcl_companion.clock import Clock
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions

_TEXT_BYTES = 50
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class Autopilot(asyncio.DatagramProtocol):
    """Answers questions about time, stays turned as it was last, keeps what it is told.

    Args:
        system_id: its vehicle's.
        boot_ns: its start, in the companion's time.
        quaternion: (4,) w x y z, ned_from_body until it is turned; whenever it is asked the
            time, it measures how it is turned then.
    """

    def __init__(self, system_id: int, boot_ns: int, quaternion: Array) -> None:
        self._system_id = system_id
        self._boot_ns = boot_ns
        self._quaternion = quaternion
        self._transport: asyncio.DatagramTransport | None = None
        self._companion: Any = None
        self._parts: list[bytes] = []
        self._asked_last = (255, 190)
        self.relay: Callable[[bytes], None] | None = None
        """Shown all that the companion sends, as a ground station is."""
        self.texts: asyncio.Queue[str] = asyncio.Queue()
        self.states: asyncio.Queue[int] = asyncio.Queue()
        self.answers: asyncio.Queue[tuple[int, int, int]] = asyncio.Queue()
        self.poses: asyncio.Queue[tuple[Any, ...]] = asyncio.Queue()
        self.others: asyncio.Queue[wire.Seen] = asyncio.Queue()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: Any) -> None:
        self._companion = addr
        if self.relay is not None:
            self.relay(data)
        for seen in wire.read(data):
            match seen.message_id:
                case wire.TIMESYNC if seen.fields[0] == 0:
                    at_ns = int(seen.fields[1])
                    now_ns = at_ns - self._boot_ns
                    self._say(wire.packed(wire.TIMESYNC, now_ns, at_ns, system=self._system_id))
                    self.measure(at_ns, self._quaternion)
                case wire.HEARTBEAT:
                    self.states.put_nowait(int(seen.fields[4]))
                case wire.STATUSTEXT:
                    self._take_text(*seen.fields)
                case wire.COMMAND_ACK:
                    command, result, progress, _, system, component = seen.fields
                    assert (system, component) == self._asked_last
                    self.answers.put_nowait((command, result, progress))
                case wire.VISION_POSITION_ESTIMATE:
                    self.poses.put_nowait(seen.fields)
                case wire.TIMESYNC | wire.COMMAND_LONG:
                    pass
                case _:
                    self.others.put_nowait(seen)

    def forward(
        self,
        command: int,
        parameter: float = 0.0,
        second: float = 0.0,
        *,
        confirmation: int = 0,
        target: int | None = None,
        component: int = 197,
        system: int = 255,
    ) -> None:
        """Hand on a ground station's command."""
        to = self._system_id if target is None else target
        self._asked_last = (system, 190)
        fields = (parameter, second, *[0.0] * 5, command, to, component, confirmation)
        self._say(wire.packed(wire.COMMAND_LONG, *fields, system=system, component=190))

    def pass_on(self, data: bytes) -> None:
        """Hand on what a ground station sends, as it is."""
        self._say(data)

    def hand_on(self, message_id: int, *fields: float | bytes, system: int = 255) -> None:
        """Hand on another message of a ground station, its fields in wire order."""
        self._say(wire.packed(message_id, *fields, system=system, component=190))

    def said_texts(self) -> list[str]:
        """Take the texts that have come so far."""
        return [self.texts.get_nowait() for _ in range(self.texts.qsize())]

    def measure(self, at_ns: int, quaternion: Array) -> None:
        """Turn, and send that attitude as one of an instant of the companion's time."""
        self._quaternion = quaternion
        boot_ms = (at_ns - self._boot_ns) // 1_000_000
        fields = (boot_ms, *(float(q) for q in quaternion), 0, 0, 0, 0, 0, 0, 0)
        self._say(wire.packed(wire.ATTITUDE_QUATERNION, *fields, system=self._system_id))

    def beat(self, autopilot: int, base_mode: int, custom_mode: int) -> None:
        """Send HEARTBEAT of a quadrotor."""
        fields = (custom_mode, 2, autopilot, base_mode, 4, 3)
        self._say(wire.packed(wire.HEARTBEAT, *fields, system=self._system_id))

    def _say(self, data: bytes) -> None:
        assert self._transport is not None
        self._transport.sendto(data, self._companion)

    def _take_text(self, _: int, text: bytes, text_id: int, __: int) -> None:
        self._parts.append(text.rstrip(b"\0"))
        if text_id == 0 or len(self._parts[-1]) < _TEXT_BYTES:
            self.texts.put_nowait(b"".join(self._parts).decode())
            self._parts.clear()


@contextlib.asynccontextmanager
async def autopilot_and_link(
    system_id: int, clock: Clock, at_ns: int, quaternion: Array = _LEVEL
) -> AsyncIterator[tuple[Autopilot, AutopilotLink]]:
    """An autopilot that was started 90 s before ``at_ns``, and the link to it, not yet running."""
    loop = asyncio.get_running_loop()
    transport, autopilot = await loop.create_datagram_endpoint(
        lambda: Autopilot(system_id, at_ns - 90_000_000_000, quaternion),
        local_addr=("127.0.0.1", 0),
    )
    try:
        port = transport.get_extra_info("sockname")[1]
        # Frames that wait for a search are answered in their order, however late.
        options = AutopilotOptions(link=f"udp:127.0.0.1:{port}", max_pose_age_s=10.0)
        yield autopilot, AutopilotLink(options, system_id, clock)
    finally:
        transport.close()
