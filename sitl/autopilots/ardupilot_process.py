"""The process of an ArduCopter built for simulation, and what is alike whatever it feels."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.firmware_process import FirmwareProcess
from sitl.autopilots.steered import open_udp
from sitl.autopilots.wire import Wire
from sitl.mission import HOME_ALTITUDE_M, HOME_DEG

_LOOK_S = 0.5
_MAX_DATAGRAM_BYTES = 65535


class ArduCopterProcess:
    """One that runs; see ``flown.Firmware`` for the rest.

    Args:
        options: what it is.
        wire: where it talks to.
        stack: ends the process.
    """

    estimator_message = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT
    position_message = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
    clock_ahead_ns: int | None = None

    def __init__(self, options: FirmwareOptions, wire: Wire, stack: ExitStack) -> None:
        self.now_ns = options.boot_offset_ns
        self._options = options
        self._wire = wire
        self._stack = stack
        self._sim: socket.socket = stack.enter_context(open_udp())
        self._sim.settimeout(_LOOK_S)

    def _start(self, model: Sequence[str], yaw_deg: float = 0.0) -> None:
        options = self._options
        options.run.mkdir(parents=True, exist_ok=True)
        defaults = options.run / "vcl.parm"
        values = {**options.parameters, "MAV_SYSID": float(options.system_id)}
        defaults.write_text("".join(f"{name} {value:g}\n" for name, value in values.items()))
        lat_deg, lon_deg = HOME_DEG
        command = (
            *(str(options.binary.resolve()), *model, "--wipe", "--speedup", "1000"),
            *("--home", f"{lat_deg},{lon_deg},{HOME_ALTITUDE_M},{yaw_deg:.6f}"),
            *("--serial0", f"udpclient:127.0.0.1:{self._wire.port}"),
            # The ports that it would listen on are one machine's, not one drone's.
            *("--serial1", "none:1", "--serial2", "none:2", "--rc-in-port", "0"),
            *("--defaults", str(defaults.resolve()), "--sysid", str(options.system_id)),
        )
        self._process = FirmwareProcess(command, options.run, os.environ, self._stack)

    def hear(self, frames: Iterable[bytes]) -> None:
        """Have it take in what reaches it now: it looks at its port in its next step."""
        for frame in frames:
            self._wire.write(frame)

    def said(self) -> Iterator[bytes]:
        """Yield what it has said to its companion."""
        return self._wire.read()

    def _heard(self, asked_at_s: float) -> tuple[bytes, tuple[str, int]]:
        """Return what it says to who simulates, and whence."""
        while True:
            try:
                data, sender = self._sim.recvfrom(_MAX_DATAGRAM_BYTES)
            except TimeoutError:
                self._process.still_there(asked_at_s)
            else:
                return data, (str(sender[0]), int(sender[1]))
