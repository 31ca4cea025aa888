"""A program that speaks ArduPilot's JSON simulator interface as its firmware does, and little else.

Written after libraries/SITL/SIM_JSON.cpp: it sends its servos and waits for the last whole line
that has come; what it said it says again while it waits. Its position is the last that it was
sent by VISION_POSITION_ESTIMATE, ``ahead`` of it by the environment's AHEAD_M.
"""

import json
import os
import socket
import struct
import sys

from pymavlink.dialects.v20 import ardupilotmega as dialect


def argument(name: str) -> str:
    return sys.argv[sys.argv.index(name) + 1]


def main() -> None:
    sensors = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sensors.settimeout(0.05)
    simulator = ("127.0.0.1", int(argument("--sim-port-out")))
    mavlink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    mavlink.setblocking(False)
    _, host, port = argument("--serial0").split(":")
    ground = (host, int(port))
    mav = dialect.MAVLink(None, int(argument("--sysid")), 1)
    parser = dialect.MAVLink(None)
    count, now_s, position = 0, 0.0, None
    ahead_m = float(os.environ.get("AHEAD_M", "0"))

    def say(message: dialect.MAVLink_message) -> None:
        mavlink.sendto(bytes(message.pack(mav)), ground)
        mav.seq = (mav.seq + 1) % 256

    while True:
        sensors.sendto(struct.pack("<HHI16H", 18458, 400, count, *[1000] * 16), simulator)
        try:
            lines = sensors.recv(65536).decode().split("\n")
        except TimeoutError:
            continue
        felt = json.loads([line for line in lines if line][-1])
        if count:
            # A step left out would be a step that its IMU never felt.
            assert abs(felt["timestamp"] - now_s - 0.0025) < 1e-5, (felt["timestamp"], now_s)
        now_s = felt["timestamp"]
        count += 1
        boot_ms = int(now_s * 1e3)
        if count % 400 == 1:
            say(dialect.MAVLink_heartbeat_message(2, 3, 81, 4, 3, 3))
            flags = 0xA7 if position is None else 0x33F
            say(dialect.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0))
        if count % 8 == 1:
            quaternion = felt["quaternion"]
            say(dialect.MAVLink_attitude_quaternion_message(boot_ms, *quaternion, 0, 0, 0))
            if position is not None:
                x, y, z = position
                say(dialect.MAVLink_local_position_ned_message(boot_ms, x + ahead_m, y, z, 0, 0, 0))
        is_pose = False
        while True:
            try:
                data = mavlink.recv(65536)
            except BlockingIOError:
                break
            for message in parser.parse_buffer(data) or []:
                # With other bytes behind it, it would be taken for older than it is.
                assert not is_pose, message
                is_pose = message.get_type() == "VISION_POSITION_ESTIMATE"
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    say(dialect.MAVLink_timesync_message(int(now_s * 1e9), message.ts1))
                elif is_pose:
                    position = (message.x, message.y, message.z)


if __name__ == "__main__":
    main()
