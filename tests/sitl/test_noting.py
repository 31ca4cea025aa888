"""At which instants a firmware says what it says of itself."""

from contextlib import ExitStack
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.noting import Noting

BOOTED_NS = 1_000_000_000_000
STEP_NS = 4_000_000
ODOMETRY = dialect.MAVLINK_MSG_ID_ODOMETRY


def answer(told_ns: int) -> dialect.MAVLink_message:
    return dialect.MAVLink_timesync_message(told_ns - BOOTED_NS, 1)


def odometry(at_ns: int) -> dialect.MAVLink_message:
    since_us = (at_ns - BOOTED_NS) // 1000
    place, level = (1.5, 2.5, -3.5), (1, 0, 0, 0)
    return dialect.MAVLink_odometry_message(
        since_us, 1, 12, *place, level, *[0.0] * 6, *[[0.0] * 21] * 2
    )


@pytest.mark.parametrize(
    ("known_ns", "late_ns"),
    [(-BOOTED_NS, 0), (None, STEP_NS)],
    ids=["a clock that we set", "a clock that is only asked for"],
)
def test_answers_that_are_all_read_a_step_late_do_not_age_what_a_clock_that_we_set_stamps(
    tmp_path: Path, known_ns: int | None, late_ns: int
) -> None:
    at_ns = BOOTED_NS + 1000 * STEP_NS
    with ExitStack() as stack:
        noting = Noting(tmp_path, ODOMETRY, known_ns, stack)
        noting.note(odometry(at_ns), at_ns)
        for k in range(5):
            noting.note(answer(at_ns + k * STEP_NS), at_ns + (k + 1) * STEP_NS)
        noting.note(odometry(at_ns + 5 * STEP_NS), at_ns + 6 * STEP_NS)

    # What it says before it has told the time counts for nothing.
    assert noting.clock_ahead_ns == -BOOTED_NS - late_ns
    (line,) = (tmp_path / "fused.csv").read_text().splitlines()[1:]
    assert line == f"{at_ns + 5 * STEP_NS + late_ns},1.5,2.5,-3.5"
