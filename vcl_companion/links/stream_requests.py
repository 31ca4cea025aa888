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
# Without attitudes there are no poses, and no telling that the autopilot has restarted.
_LONGEST_PAUSE_S, _LONGEST_WITHOUT_ATTITUDE_S = 16.0, 2.0
_POSITION_HZ = 10.0
_ESTIMATOR_HZ = 5.0
_ESTIMATORS = {
    Firmware.ARDUPILOT: (EKF_STATUS_REPORT_ID,),
    Firmware.PX4: (ESTIMATOR_STATUS_ID,),
    Firmware.OTHER: (),
}


class StreamRequests:
    """Asks for streams by MAV_CMD_SET_MESSAGE_INTERVAL, ever less often for one that does not come.

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
        pauses: dict[int, tuple[float, float]] = {}  # what is left of it, and how long it is
        while True:
            before = self._n_heard.copy()
            await asyncio.sleep(_CHECK_S)
            for message_id, rate_hz in self._wanted().items():
                if self._n_heard[message_id] - before[message_id] >= 0.5 * rate_hz * _CHECK_S:
                    pauses.pop(message_id, None)
                    continue
                left_s, pause_s = pauses.get(message_id, (0.0, _CHECK_S))
                if left_s <= 0.0:
                    self._ask(message_id, round(1e6 / rate_hz))
                    is_attitude = message_id == ATTITUDE_QUATERNION_ID
                    longest_s = _LONGEST_WITHOUT_ATTITUDE_S if is_attitude else _LONGEST_PAUSE_S
                    left_s, pause_s = pause_s, min(2.0 * pause_s, longest_s)
                pauses[message_id] = left_s - _CHECK_S, pause_s

    def _wanted(self) -> dict[int, float]:
        """Return the rate of each stream, Hz."""
        return {
            ATTITUDE_QUATERNION_ID: self._attitude_rate_hz,
            LOCAL_POSITION_ID: _POSITION_HZ,
            **dict.fromkeys(_ESTIMATORS[self.firmware], _ESTIMATOR_HZ),
        }
