import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.pacing import ATTITUDE_PERIOD_NS, Due, Instant, Pace, gate, instants

TIMES = st.lists(st.integers(0, 10**9), min_size=1, max_size=12, unique=True).map(sorted)


@given(st.lists(TIMES, min_size=1, max_size=3), st.booleans())
def test_every_frame_comes_once_and_in_time_order(times: list[list[int]], flat_out: bool) -> None:
    moments = instants([np.array(t, dtype=np.int64) for t in times], flat_out)
    at_ns = [moment.at_ns for moment in moments]
    assert at_ns == sorted(set(at_ns))
    given_out = [(due, moment.at_ns) for moment in moments for due in moment.frames]
    expected = [(Due(n, k), t) for n, drone in enumerate(times) for k, t in enumerate(drone)]
    assert sorted(given_out, key=str) == sorted(expected, key=str)


@given(st.lists(TIMES, min_size=1, max_size=3), st.booleans())
def test_a_frame_is_followed_by_an_attitude_before_long(
    times: list[list[int]], flat_out: bool
) -> None:
    """A daemon that waits for the sample after a frame never waits for the frame after it."""
    moments = instants([np.array(t, dtype=np.int64) for t in times], flat_out)
    for moment, following in pairwise(moments):
        if moment.frames:
            assert following.at_ns - moment.at_ns <= ATTITUDE_PERIOD_NS
    assert not moments[-1].frames or not flat_out


def test_against_the_wall_clock_the_autopilots_speak_at_50_hz() -> None:
    moments = instants([np.array([0, 200_000_000])], flat_out=False)
    assert [m.at_ns for m in moments] == [k * 20_000_000 for k in range(12)]
    assert [m.at_ns for m in moments if m.frames] == [0, 200_000_000]


def test_flat_out_nothing_happens_between_frames_but_one_sample() -> None:
    times = [np.array([0, 200_000_000]), np.array([3_000_000, 203_000_000])]
    moments = instants(times, flat_out=True)
    assert [m.at_ns // 1_000_000 for m in moments] == [0, 3, 23, 200, 203, 223]


def test_the_first_map_is_waited_for_when_all_have_their_first_frame() -> None:
    times = [np.array([0, 200, 400]), np.array([250, 450])]
    moments = instants([t * 1_000_000 for t in times], flat_out=True)
    assert [m.at_ns // 1_000_000 for m in moments][gate(moments, {0, 1})] == 270
    hurried = [Instant(0, (Due(0, 0),)), Instant(5, (Due(1, 0),)), Instant(9, (Due(0, 1),))]
    assert gate(hurried, {0, 1}) == 1
    with pytest.raises(ValueError, match="no frame"):
        gate(hurried, {0, 1, 2})


def test_pace_counts_from_its_origin() -> None:
    pace = Pace(2.0, 1_000_000_000, 50.0)
    assert pace.wait_s(3_000_000_000, 50.0) == pytest.approx(1.0)
    assert pace.wait_s(3_000_000_000, 51.5) == pytest.approx(-0.5)
    assert Pace(math.inf, 0, 0.0).wait_s(10**12, 0.0) == 0.0
