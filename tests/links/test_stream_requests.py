"""Streams are asked for until they come, each by itself."""

from __future__ import annotations

import asyncio

from tests.daemon.waiting import beside, hurry, run
from vcl_companion.links.messages import (
    ATTITUDE_QUATERNION_ID,
    EKF_STATUS_REPORT_ID,
    LOCAL_POSITION_ID,
)
from vcl_companion.links.stream_requests import StreamRequests
from vcl_companion.links.vision_pose import Firmware


def asked(seconds: int, silent_from_s: int, *streamed: int) -> list[tuple[int, int]]:
    """Return seconds and messages that are asked for, of an autopilot that streams some at first.

    It answers none of what it is asked.
    """
    out: list[tuple[int, int]] = []

    async def scenario() -> None:
        now_s = 0
        requests = StreamRequests(50.0, lambda message_id, _: out.append((now_s, message_id)))
        requests.firmware = Firmware.ARDUPILOT
        async with beside(requests.run()):
            await asyncio.sleep(0)
            for now_s in range(1, seconds + 1):
                for message_id in streamed if now_s <= silent_from_s else ():
                    for _ in range(50):
                        requests.heard(message_id)
                hurry(1.0)
                for _ in range(3):
                    await asyncio.sleep(0.001)

    run(scenario())
    return out


def test_what_never_comes_is_asked_for_ever_less_often() -> None:
    found = asked(60, 60, ATTITUDE_QUATERNION_ID, EKF_STATUS_REPORT_ID)
    assert {message_id for _, message_id in found} == {LOCAL_POSITION_ID}
    assert 5 <= len(found) <= 8


def test_what_has_come_is_asked_for_at_once_whatever_else_never_comes() -> None:
    found = asked(60, 50, ATTITUDE_QUATERNION_ID, EKF_STATUS_REPORT_ID)
    again_s = [s for s, message_id in found if message_id == ATTITUDE_QUATERNION_ID]
    assert 51 <= again_s[0] <= 52
    # Its restart takes a while: it is asked often enough to answer soon after.
    assert len(again_s) >= 4
