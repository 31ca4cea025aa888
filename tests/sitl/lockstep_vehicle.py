"""A program that speaks PX4's MAVLink simulator interface as its firmware does, and little else.

Written after src/modules/simulation/simulator_mavlink: it finds its ports in the scripts that
stand in its folder, answers each HIL_SENSOR by HIL_ACTUATOR_CONTROLS of its time, and asks for the
time ten times a second. Its attitude is what its sensors say: level and north at first, turned on
by its rates. Its position is the last that it was sent by VISION_POSITION_ESTIMATE; it has one
only once it was told the time, at once. What it is told it reads at any time, as a thread does, but
only when nobody moves its clock on meanwhile; its LOCAL_POSITION_NED is not its position.
"""

import math
import os
import re
import select
import socket
import sys
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect
from scipy.spatial.transform import Rotation

NOWHERE_M = 1.5
STARTS_AFTER = 5
STEP_US = 4000
ALIGNS_WITH = 200


class Attitude:
    """Which way it stands, by its own sensors."""

    def __init__(self) -> None:
        self.ned_from_body: Rotation | None = None
        self._forces: list[np.ndarray] = []
        self._fields: list[np.ndarray] = []

    def feel(self, felt: dialect.MAVLink_message) -> None:
        """Take in what its sensors say at a step."""
        if self.ned_from_body is not None:
            rates = np.array([felt.xgyro, felt.ygyro, felt.zgyro])
            self.ned_from_body *= Rotation.from_rotvec(rates * STEP_US * 1e-6)
            return
        self._forces.append(np.array([felt.xacc, felt.yacc, felt.zacc]))
        if felt.fields_updated & 0x1C0:
            self._fields.append(np.array([felt.xmag, felt.ymag, felt.zmag]))
        if len(self._forces) == ALIGNS_WITH:
            down = -np.mean(self._forces, axis=0)
            east = np.cross(down, np.mean(self._fields, axis=0))
            axes = np.array([np.cross(east, down), east, down])
            lengths = np.linalg.norm(axes, axis=1, keepdims=True)
            self.ned_from_body = Rotation.from_matrix(axes / lengths)


def number_in(script: str, pattern: str) -> int:
    """Return what a script of the folder that the program runs in says."""
    found = re.search(pattern, Path(script).read_text())
    assert found, script
    return int(found[1])


def main() -> None:
    folder = sys.argv[sys.argv.index("-w") + 1]
    os.chdir(folder)
    assert folder == os.environ["PATH"].split(":")[0]
    assert os.environ["PX4_PARAM_EKF2_EV_CTRL"] == "11"
    assert os.environ["PX4_PARAM_EKF2_HGT_REF"] == "3"
    # A step of its estimator for each reading of its sensors.
    assert float(os.environ["PX4_PARAM_EKF2_PREDICT_US"]) == STEP_US
    simulator_port = number_in(
        "px4-rc.mavlinksim", r"simulator_mavlink start -t 127\.0\.0\.1 (\d+)"
    )
    system = number_in("px4-rc.mavlinksim", r"param set MAV_SYS_ID (\d+)")
    ground = ("127.0.0.1", number_in("px4-rc.mavlink", r"-o (\d+)"))
    simulator = socket.create_connection(("127.0.0.1", simulator_port))
    mavlink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    mavlink.setblocking(False)
    mav = dialect.MAVLink(None, system, 1)
    parser = dialect.MAVLink(None)
    readings = dialect.MAVLink(None)
    attitude = Attitude()
    position: tuple[float, float, float] | None = None
    count, now_us, ahead_us = 0, 0, None
    dies_after = int(os.environ.get("DIES_AFTER_STEPS", "0"))

    def say(message: dialect.MAVLink_message) -> None:
        mavlink.sendto(bytes(message.pack(mav)), ground)
        mav.seq = (mav.seq + 1) % 256

    def hear(message: dialect.MAVLink_message) -> None:
        nonlocal position, ahead_us
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            # What the ground asked after a step was answered before the clock went on.
            then_us = now_us - (STEP_US if message.ts1 > 0 else 0)
            say(dialect.MAVLink_timesync_message(then_us * 1000, message.ts1))
        elif message.get_type() == "TIMESYNC":
            assert now_us * 1000 - message.ts1 <= 2 * STEP_US * 1000, "the time came late"
            told_us = message.tc1 // 1000 - (message.ts1 // 1000 + now_us) // 2
            assert ahead_us in (None, told_us), (ahead_us, told_us)
            ahead_us = told_us
        elif message.get_type() == "VISION_POSITION_ESTIMATE" and ahead_us is not None:
            late_us = now_us + ahead_us - message.usec
            assert 0 <= late_us <= 400_000, late_us
            position = (message.x, message.y, message.z)

    def live() -> None:
        boot_ms = now_us // 1000
        if count % 250 == 1:
            say(dialect.MAVLink_heartbeat_message(2, 12, 81, 4, 3, 3))
            flags, ratio = (0x25, math.nan) if position is None else (0x12F, 0.1)
            say(dialect.MAVLink_estimator_status_message(now_us, flags, 0, ratio, *[0.0] * 6))
        if count % 25 == 2:
            # Every other question was under way for a step.
            asked_us = now_us - (count // 25 % 2) * STEP_US
            say(dialect.MAVLink_timesync_message(0, asked_us * 1000))
        if count % 5 == 1 and attitude.ned_from_body is not None:
            x, y, z, w = attitude.ned_from_body.as_quat()
            say(dialect.MAVLink_attitude_quaternion_message(boot_ms, w, x, y, z, 0, 0, 0))
            if position is not None:
                x, y, z = position
                say(
                    dialect.MAVLink_local_position_ned_message(
                        boot_ms, x, y, z + NOWHERE_M, 0, 0, 0
                    )
                )
                say(
                    dialect.MAVLink_odometry_message(
                        now_us, 1, 12, *position, (1, 0, 0, 0), *[0.0] * 6, *[[0.0] * 21] * 2
                    )
                )

    def read() -> None:
        while True:
            try:
                heard = mavlink.recv(65536)
            except BlockingIOError:
                return
            for message in parser.parse_buffer(heard) or []:
                hear(message)

    while True:
        ready, _, _ = select.select([simulator, mavlink], [], [])
        if simulator not in ready and simulator not in select.select([simulator], [], [], 1e-3)[0]:
            read()
            continue
        data = simulator.recv(65536)
        if not data:
            return
        for felt in readings.parse_buffer(data) or []:
            # A step left out would be a step that its sensors never felt.
            assert felt.time_usec == now_us + STEP_US, (felt.time_usec, now_us)
            assert felt.fields_updated & 0x3F == 0x3F
            now_us = felt.time_usec
            count += 1
            if count == dies_after:
                sys.exit(4)
            attitude.feel(felt)
            read()
            live()
            if count > STARTS_AFTER:
                answer = dialect.MAVLink_hil_actuator_controls_message(now_us, [0.0] * 16, 1, 1)
                simulator.sendall(bytes(answer.pack(mav)))


if __name__ == "__main__":
    main()
