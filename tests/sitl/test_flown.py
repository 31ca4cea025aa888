"""What reaches a firmware from its companion, and when."""

import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.flown import Flown
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.steered import open_udp
from sitl.autopilots.wire import Wire

STEP_NS = 1_000_000
BEGINS_NS = 1_000_000_000_000


class Listener:
    """A firmware that notes what it hears, and at which step."""

    estimator_message = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    position_message = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    clock_ahead_ns: int | None = None

    def __init__(self) -> None:
        self.now_ns = BEGINS_NS
        self.heard: list[tuple[int, list[str]]] = []

    def is_due(self, until_ns: int) -> bool:
        return self.now_ns + STEP_NS <= until_ns

    def step(self) -> None:
        self.now_ns += STEP_NS

    def hear(self, frames: Iterable[bytes]) -> None:
        parser = dialect.MAVLink(None)
        names = [parser.parse_buffer(frame)[0].get_type() for frame in frames]
        self.heard.append(((self.now_ns - BEGINS_NS) // STEP_NS, names))

    def said(self) -> Iterator[bytes]:
        return iter(())


def test_nothing_is_read_together_with_a_pose_that_it_came_behind(tmp_path: Path) -> None:
    at_ns = BEGINS_NS + np.arange(4) * 50_000_000
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    options = FirmwareOptions(
        Path("/bin/true"), 3, BEGINS_NS, RecordedMotion(at_ns, np.zeros((4, 3)), upright),
        {}, 0.0, tmp_path / "out", tmp_path / "run",
    )  # fmt: skip
    listener = Listener()

    def start(_: FirmwareOptions, wire: Wire, stack: ExitStack) -> Listener:
        return listener

    codec = dialect.MAVLink(None, 3, dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY)
    text = dialect.MAVLink_statustext_message(6, b"VCL fused")
    pose = dialect.MAVLink_vision_position_estimate_message(1, 0, 0, 0, 0, 0, 0)
    odometry = dialect.MAVLink_odometry_message(
        1, 20, 8, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0.0] * 21, [0.0] * 21
    )
    with ExitStack() as stack:
        udp = stack.enter_context(open_udp())
        flown = Flown(options, start, udp, stack)
        companion = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        for message in (text, pose, text, text, odometry, pose):
            companion.sendto(bytes(message.pack(codec)), udp.getsockname())
        flown.advance_to(BEGINS_NS + 20 * STEP_NS)

    assert listener.heard == [
        (0, ["STATUSTEXT", "VISION_POSITION_ESTIMATE"]),
        (5, ["STATUSTEXT", "STATUSTEXT", "ODOMETRY"]),
        (10, ["VISION_POSITION_ESTIMATE"]),
    ]
