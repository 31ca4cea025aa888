"""A real PX4 in a flight: ``python -m sitl.autopilots.px4 CONFIG.json``.

In a recorded flight its simulated sensors get the recording's true motion; in a live one a model
of a quad flies as it commands (``px4_quad``). See ``flown``, and ``firmware_options`` for the
configuration, whose ``binary`` is ``bin/px4`` in the folder of a build for ``px4_sitl_default``.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from sitl.autopilots.firmware_options import FirmwareOptions, Orders, read_options
from sitl.autopilots.flown import Firmware, run_flown
from sitl.autopilots.hil_sensors import hil_sensors
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.px4_parameters import RECORDED, of_a_mission
from sitl.autopilots.px4_process import STEP_NS, Px4Process
from sitl.autopilots.px4_quad import Px4Quad
from sitl.autopilots.wire import Wire

_CHUNK = 2500
# Its propellers turn so long before the recording begins.
_TAKEN_OFF_BEFORE_NS = 5_000_000_000
_MODEL = "none_iris"


class Px4(Px4Process):
    """One that feels a recorded motion; see ``flown.Firmware``.

    Args:
        options: what it is.
        motion: what it feels.
        wire: where it talks to.
        stack: ends the process.
        tells_time: whether its questions for the time are answered in the companion's place.
    """

    def __init__(
        self,
        options: FirmwareOptions,
        motion: RecordedMotion,
        wire: Wire,
        stack: ExitStack,
        *,
        tells_time: bool = True,
    ) -> None:
        self._motion = motion
        self._chunk: list[Any] = []  # of steps to come, the next one last
        super().__init__(options, _MODEL, wire, stack, tells_time=tells_time)

    def _reading(self) -> Any:
        if not self._chunk:
            at_ns = self.now_ns + STEP_NS * np.arange(1, _CHUNK + 1)
            shaken = at_ns > self._motion.starts_ns - _TAKEN_OFF_BEFORE_NS
            since_us = (at_ns - self._boot_ns) // 1000
            self._chunk = hil_sensors(self._motion.at(at_ns), since_us, shaken, self._rng)[::-1]
        return self._chunk.pop()


def start(options: FirmwareOptions, wire: Wire, stack: ExitStack) -> Firmware:
    """Start the one that a configuration is of."""
    if isinstance(options.flies, Orders):
        return Px4Quad(options, options.flies.mission, wire, stack)
    return Px4(options, options.flies, wire, stack)


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""

    def read(path: Path) -> FirmwareOptions:
        options = read_options(path)
        flies = options.flies
        return options.over(of_a_mission(flies.mission) if isinstance(flies, Orders) else RECORDED)

    return run_flown("px4", arguments, read, start)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
