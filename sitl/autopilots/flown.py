"""A real firmware in a flight, between its sensors and its companion.

The firmware runs in software beside this process, which gives its simulated sensors a
recording's true motion, or lets it fly by itself, commanded by a pilot. It runs in lockstep: its
time is the flight's (``steered``). What it makes of the companion's poses is written down
(``noting``), and what it hears, like the stand-in.
"""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions, Orders
from sitl.autopilots.hearing import Hearing, datagrams
from sitl.autopilots.noting import Noting
from sitl.autopilots.own_network import enter_own_network
from sitl.autopilots.pilot import Phase, Pilot
from sitl.autopilots.speaking import Backlog, packed
from sitl.autopilots.steered import open_udp, run_steered, serve
from sitl.autopilots.wire import Wire
from sitl.pacing import ATTITUDE_PERIOD_NS
from vcl_companion.geometry.pose import Pose

_HEARTBEAT_S = 1.0
_GROUND_SYSTEM, _GROUND_COMPONENT = 255, 190
_STREAM_US, _ESTIMATOR_US = 20_000, 200_000
# Two of ArduCopter's loops, in each of which it looks at its port once.
_AFTER_A_POSE_NS = 5_000_000
_POSES = (dialect.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE, dialect.MAVLINK_MSG_ID_ODOMETRY)


class Firmware(Protocol):
    """Whosever firmware it is: its clock, its sensors, its ears.

    Attributes:
        now_ns: the instant of the recording that it has come to.
        estimator_message: id of the message that has its estimator's flags.
        position_message: id of the one that has its position, and its instant.
        clock_ahead_ns: its clock minus the recording's; None: as it answers who asks for it.
    """

    now_ns: int
    estimator_message: int
    position_message: int
    clock_ahead_ns: int | None

    def is_due(self, until_ns: int) -> bool:
        """Return whether one more step is to be done until an instant."""
        ...

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        ...

    def hear(self, frames: Iterable[bytes]) -> None:
        """Have it take in what reaches it now."""
        ...

    def said(self) -> Iterator[bytes]:
        """Yield what it has said to its companion."""
        ...


@runtime_checkable
class FlyingFirmware(Firmware, Protocol):
    """One that flies by its own physics.

    Attributes:
        pilot: who can command it.
    """

    pilot: type[Pilot]

    def ned_from_body(self, at_ns: int) -> Pose:
        """Return where it truly is at an instant of its last step."""
        ...


Start = Callable[[FirmwareOptions, Wire, ExitStack], Firmware]


class Flown:
    """The firmware with its companion on the other side; see ``Steered``.

    Args:
        options: what it is.
        start: starts it.
        udp: the companion's end.
        stack: ends it, and closes what is written.
    """

    def __init__(
        self, options: FirmwareOptions, start: Start, udp: socket.socket, stack: ExitStack
    ) -> None:
        self._options = options
        self._udp = udp
        options.out.mkdir(parents=True, exist_ok=True)
        received = stack.enter_context((options.out / "received.jsonl").open("w", buffering=1))
        self._hearing = Hearing(received)
        self.wire = Wire(stack)
        self._firmware = start(options, self.wire, stack)
        self._noting = Noting(
            options.out, self._firmware.position_message, self._firmware.clock_ahead_ns, stack
        )
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._ground = dialect.MAVLink(None, _GROUND_SYSTEM, _GROUND_COMPONENT)
        self._as_firmware = dialect.MAVLink(None, options.system_id, 1)
        self._pilot: Pilot | None = None
        if isinstance(options.flies, Orders) and isinstance(self._firmware, FlyingFirmware):
            self._pilot = self._firmware.pilot(
                options.flies, options.system_id, self._command, options.out, stack
            )
        self._companion: tuple[str, int] | None = None
        self._backlog = Backlog()
        # What the companion has sent, when that arrives, and whether it is a pose.
        self._under_way: deque[tuple[int, bytes, bool]] = deque()
        self._not_before_ns = 0
        self._stopped_at_s = time.monotonic()
        self._asked = False
        self.n_times_told = 0

    def advance_to(self, until_ns: int) -> int:
        """Move the firmware on to an instant; return the one asked for."""
        self.receive()
        while self._firmware.is_due(until_ns):
            self._hand_over()
            self._firmware.step()
            self._hand_on()
        if self._pilot is not None:
            self._pilot.go_on(until_ns)
        self._stopped_at_s = time.monotonic()
        return until_ns

    def state(self, at_ns: int) -> dict[str, object]:
        """Return where it truly is and how far its mission has come, if it flies by itself."""
        if self._pilot is None or not isinstance(self._firmware, FlyingFirmware):
            return {}
        pose = self._firmware.ned_from_body(at_ns)
        return {
            "pose": [*pose.translation.tolist(), *pose.quaternion().tolist()],
            "mission": self._pilot.says,
            "is_over": self._pilot.phase is Phase.OVER,
            "trouble": self._pilot.trouble,
        }

    def receive(self) -> None:
        """Take in what the companion has sent: it arrives as much later as that took it.

        The firmware's clock has stood still meanwhile, but for longer than from one stop to the
        next only because the recording was held. Flat out the companion's work takes no time.
        """
        took_s = (time.monotonic() - self._stopped_at_s) * self._options.speed
        arrives_ns = self._firmware.now_ns + min(round(took_s * 1e9), ATTITUDE_PERIOD_NS)
        for data, sender in datagrams(self._udp):
            if sender != self._companion:
                self._companion = sender
                for frame in self._backlog:
                    self._udp.sendto(frame, sender)
            for message in self._hearing.of(data, self._firmware.now_ns):
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    self._tell_time(message.ts1)
                else:
                    is_pose = message.get_msgId() in _POSES
                    self._under_way.append((arrives_ns, bytes(message.get_msgbuf()), is_pose))
        # What its own threads have brought out since it stopped.
        self._hand_on()

    def heartbeat_if_due(self) -> float:
        """Return the seconds to the next look: the firmware's heartbeats go by its own time."""
        return _HEARTBEAT_S

    def _hand_over(self) -> None:
        """Give the firmware what has arrived by now, up to a pose.

        What comes behind that waits until it is read: ArduPilot takes a pose for older by what all
        bytes that it has then took at its port's rate (``receive_time_constraint_us``), 10 ms for
        115 of them, and from there on all poses for as much older (``JitterCorrection``).
        """
        now_ns = self._firmware.now_ns
        frames: list[bytes] = []
        while self._not_before_ns <= now_ns and self._under_way and self._under_way[0][0] <= now_ns:
            _, frame, is_pose = self._under_way.popleft()
            frames.append(frame)
            if is_pose:
                self._not_before_ns = now_ns + _AFTER_A_POSE_NS
        if frames:
            self._firmware.hear(frames)

    def _tell_time(self, asked_ns: int) -> None:
        """Say for the firmware what its clock shows: while it stands still, it cannot itself."""
        ahead_ns = self._noting.clock_ahead_ns
        if ahead_ns is None:
            return
        now_ns = max(1, self._firmware.now_ns + ahead_ns)
        if self._companion is not None:
            answer = dialect.MAVLink_timesync_message(now_ns, asked_ns)
            self._udp.sendto(packed(answer, self._as_firmware), self._companion)
        self.n_times_told += 1

    def _hand_on(self) -> None:
        """Hand on what the firmware has said, and note what it says of itself."""
        now_ns = self._firmware.now_ns
        for data in self._firmware.said():
            self._backlog.add(now_ns, data)
            if self._companion is not None:
                self._udp.sendto(data, self._companion)
            for message in self._parser.parse_buffer(data) or []:
                self._noting.note(message, now_ns)
                if self._pilot is not None:
                    self._pilot.hear(message)
                if message.get_type() == "HEARTBEAT":
                    self._beat()

    def _beat(self) -> None:
        """Answer a heartbeat as a ground station does: with one, and what it wants to hear."""
        messages: list[Any] = [
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
            ),
            dialect.MAVLink_timesync_message(0, self._firmware.now_ns),
        ]
        if not self._asked:
            self._asked = True
            # Attitude is asked for by the companion as well, but not before the recording begins.
            streams_us = {
                dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _STREAM_US,
                self._firmware.position_message: _STREAM_US,
                dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _STREAM_US,
                dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _ESTIMATOR_US,
                self._firmware.estimator_message: _ESTIMATOR_US,
            }
            for wanted, interval_us in streams_us.items():
                messages.append(
                    dialect.MAVLink_command_long_message(
                        self._options.system_id, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                        wanted, interval_us, 0, 0, 0, 0, 0,
                    )
                )  # fmt: skip
        for message in messages:
            self._command(message)

    def _command(self, message: Any) -> None:
        self.wire.write(packed(message, self._ground))


def run_flown(
    name: str,
    arguments: list[str],
    read: Callable[[Path], FirmwareOptions],
    start: Start,
    *,
    has_fixed_ports: bool = False,
) -> int:
    """Serve from the command line until told to finish, or until stdin ends; return the exit code.

    Args:
        name: of the module.
        arguments: of the command line.
        read: reads its configuration.
        start: starts the firmware.
        has_fixed_ports: whether one that flies by itself takes ports that are always the same.
    """

    def run(path: Path) -> None:
        options = read(path)
        with ExitStack() as stack:
            udp = stack.enter_context(open_udp())
            if has_fixed_ports and isinstance(options.flies, Orders):
                # The companion's socket stays where it is.
                enter_own_network()
            autopilot = Flown(options, start, udp, stack)
            serve(autopilot, udp, autopilot.wire.socket)

    return run_steered(name, arguments, run)
