"""What a real firmware says of itself, written down for the report.

``attitude.csv``, where its nose points (ATTITUDE_QUATERNION); ``fused.csv``, where it believes to
be (``at_ns,x,y,z`` of its position message, which PX4 sends before it has one, too);
``global.csv``, where on Earth, once it knows (``at_ns,latitude_deg,longitude_deg,altitude_m`` of
GLOBAL_POSITION_INT); ``said.csv``, its texts and its estimator's flags.
"""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from pymavlink.dialects.v20 import ardupilotmega as dialect

_ESTIMATOR_KINDS = ("EKF_STATUS_REPORT", "ESTIMATOR_STATUS")


class Noting:
    """Writes down what is worth it, at instants of the recording.

    Args:
        out: the folder of the files.
        position_message: id of the one that has its position: LOCAL_POSITION_NED, or ODOMETRY.
        clock_ahead_ns: its clock minus the recording's; None: to be learned from what it answers.
        stack: closes them.
    """

    def __init__(
        self, out: Path, position_message: int, clock_ahead_ns: int | None, stack: ExitStack
    ) -> None:
        self._position_message = position_message
        self._known_ahead_ns = clock_ahead_ns

        def opened(name: str, head: str) -> TextIO:
            file = stack.enter_context((out / name).open("w", buffering=1))
            file.write(head)
            return file

        self._attitudes = opened("attitude.csv", "at_ns,qw,qx,qy,qz\n")
        self._fused = opened("fused.csv", "at_ns,x,y,z\n")
        self._places = opened("global.csv", "at_ns,latitude_deg,longitude_deg,altitude_m\n")
        self._texts = opened("said.csv", "at_ns,severity,text\n")
        self._flags = -1
        self.clock_ahead_ns: int | None = None
        """The firmware's clock minus the recording's; None until it has told the time."""

    def note(self, message: Any, now_ns: int) -> None:
        """Take down one of its messages, read at an instant of the recording."""
        kind = message.get_type()
        if kind == "TIMESYNC" and message.tc1 != 0:
            # It answers within a step or a few: the longest lead is the truest, and still a step
            # short where each answer is read a step after it was given.
            ahead_ns = self._known_ahead_ns
            if ahead_ns is None:
                ahead_ns = message.tc1 - now_ns
            if self.clock_ahead_ns is None or ahead_ns > self.clock_ahead_ns:
                self.clock_ahead_ns = ahead_ns
        elif kind == "STATUSTEXT":
            self._texts.write(f"{now_ns},{message.severity},{json.dumps(message.text)}\n")
        elif kind in _ESTIMATOR_KINDS and message.flags != self._flags:
            self._flags = message.flags
            self._texts.write(f'{now_ns},6,"estimator flags {message.flags:#x}"\n')
        elif self.clock_ahead_ns is None:
            return
        elif kind == "ATTITUDE_QUATERNION":
            at_ns = message.time_boot_ms * 1_000_000 - self.clock_ahead_ns
            quaternion = (message.q1, message.q2, message.q3, message.q4)
            self._attitudes.write(f"{at_ns},{','.join(map(repr, quaternion))}\n")
        elif message.get_msgId() == self._position_message:
            has_us = self._position_message == dialect.MAVLINK_MSG_ID_ODOMETRY
            since_us = message.time_usec if has_us else message.time_boot_ms * 1000
            at_ns = since_us * 1000 - self.clock_ahead_ns
            self._fused.write(f"{at_ns},{message.x!r},{message.y!r},{message.z!r}\n")
        elif kind == "GLOBAL_POSITION_INT" and (message.lat or message.lon):
            at_ns = message.time_boot_ms * 1_000_000 - self.clock_ahead_ns
            latitude_deg, longitude_deg = message.lat * 1e-7, message.lon * 1e-7
            place = f"{latitude_deg:.7f},{longitude_deg:.7f},{message.alt * 1e-3:.3f}"
            self._places.write(f"{at_ns},{place}\n")
