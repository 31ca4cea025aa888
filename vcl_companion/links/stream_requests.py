"""Which messages the autopilot is asked to stream, and again while they do not come."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable

from vcl_companion.links.messages import (
    ATTITUDE_QUATERNION_ID,
    EKF_STATUS_REPORT_ID,
    ESTIMATOR_STATUS_ID,
    LOCAL_POSITION_ID,
)
from vcl_companion.links.vision_pose import Firmware

_CHECK_S = 1.0
_LONGEST_PAUSE_S = 16.0
_POSITION_HZ = 10.0
_ESTIMATOR_HZ = 5.0
_ESTIMATORS = {
    Firmware.ARDUPILOT: (EKF_STATUS_REPORT_ID,),
    Firmware.PX4: (ESTIMATOR_STATUS_ID,),
    Firmware.OTHER: (),
}


class StreamRequests:
    """Asks for streams by MAV_CMD_SET_MESSAGE_INTERVAL, ever less often where one does not come.

    Args:
        attitude_rate_hz: of ATTITUDE_QUATERNION.
        ask: sends the command, with a message's id and its interval in us.
    """

    def __init__(self, attitude_rate_hz: float, ask: Callable[[int, int], None]) -> None:
        self._attitude_rate_hz = attitude_rate_hz
        self._ask = ask
        self._n_heard: Counter[int] = Counter()
        self.firmware = Firmware.OTHER

    def heard(self, message_id: int) -> None:
        """Note that one of a stream has come."""
        self._n_heard[message_id] += 1

    def ask_for_all(self) -> None:
        """Ask for every stream."""
        for message_id, rate_hz in self._wanted().items():
            self._ask(message_id, round(1e6 / rate_hz))

    async def run(self) -> None:
        """Ask for each stream while less than half of it comes, until cancelled."""
        pause_s = _CHECK_S
        while True:
            before = self._n_heard.copy()
            await asyncio.sleep(pause_s)
            missing = {
                message_id: rate_hz
                for message_id, rate_hz in self._wanted().items()
                if self._n_heard[message_id] - before[message_id] < 0.5 * rate_hz * pause_s
            }
            for message_id, rate_hz in missing.items():
                self._ask(message_id, round(1e6 / rate_hz))
            pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S) if missing else _CHECK_S

    def _wanted(self) -> dict[int, float]:
        """Return the rate of each stream, Hz."""
        return {
            ATTITUDE_QUATERNION_ID: self._attitude_rate_hz,
            LOCAL_POSITION_ID: _POSITION_HZ,
            **dict.fromkeys(_ESTIMATORS[self.firmware], _ESTIMATOR_HZ),
        }
