"""Which frames' poses an autopilot is told, and when it is told one between them."""

from __future__ import annotations

import itertools

import pytest

from vcl_companion.daemon.pacer import Pacer

START_NS = 1_721_300_000_000_000_000
MS = 1_000_000


def flown(
    rate_hz: float,
    min_rate_hz: float,
    max_rate_hz: float = 30.0,
    seconds: float = 4.0,
    jitter_ms: int = 0,
) -> tuple[list[int], list[int]]:
    """Tell every frame that may be, and all between; return both's instants, ns from the start."""
    pacer = Pacer(min_rate_hz, max_rate_hz)
    frames, between = [], []
    for k in range(round(seconds * rate_hz)):
        off_ns = (k * 7919 % (2 * jitter_ms + 1) - jitter_ms) * MS
        at_ns = START_NS + round(k / rate_hz * 1e9) + off_ns
        while (slot := pacer.next_between()) is not None and slot.due_ns < at_ns:
            assert slot.at_ns < at_ns - pacer.room_ns
            pacer.told_between(slot.at_ns)
            between.append(slot.at_ns - START_NS)
        pacer.arrived(at_ns)
        if not pacer.holds_back(at_ns):
            pacer.told(at_ns, 20 * MS)
            frames.append(at_ns - START_NS)
    return frames, between


@pytest.mark.parametrize("rate_hz", [2.0, 3.0, 5.0, 7.0, 8.0, 10.0, 15.0, 20.0, 30.0])
def test_at_least_so_many_poses_are_told_whatever_the_camera_gives(rate_hz: float) -> None:
    frames, between = flown(rate_hz, 10.0)
    assert len(frames) == round(4.0 * rate_hz)
    # Two frames tell how far they are apart.
    told = sorted(t for t in (*frames, *between) if t >= frames[2])
    steps = [b - a for a, b in itertools.pairwise(told)]
    assert max(steps) <= 126 * MS  # no more are put between for a quarter
    assert min(steps) >= 32 * MS
    assert bool(between) is (rate_hz < 8.0)


@pytest.mark.parametrize(("rate_hz", "kept_hz"), [(30.0, 30.0), (60.0, 30.0), (40.0, 26.7)])
def test_frames_beyond_the_highest_rate_are_held_back(rate_hz: float, kept_hz: float) -> None:
    frames, between = flown(rate_hz, 10.0, seconds=10.0)
    assert not between
    assert len(frames) == pytest.approx(10.0 * kept_hz, rel=0.15)
    assert len(frames) <= 301


def test_a_camera_of_thirty_hertz_that_jitters_is_told_whole() -> None:
    frames, between = flown(30.0, 10.0, seconds=10.0, jitter_ms=4)
    assert (len(frames), between) == (300, [])


def test_none_is_told_between_frames_where_that_is_not_asked_for() -> None:
    assert flown(5.0, 0.0)[1] == []


def test_no_pose_is_told_after_a_later_one() -> None:
    pacer = Pacer(10.0, 30.0)
    pacer.told(START_NS, 0)
    assert "a later pose" in pacer.holds_back(START_NS)
    assert "a later pose" in pacer.holds_back(START_NS - 1)
    # The message counts microseconds: what it cannot tell apart is one instant.
    assert "a later pose" in pacer.holds_back(START_NS + 999)
    pacer.told_between(START_NS + 100 * MS)
    assert "a later pose" in pacer.holds_back(START_NS + 60 * MS)
    assert pacer.holds_back(START_NS + 101 * MS) == ""


def test_what_lies_where_a_frame_is_expected_waits_longer_for_it() -> None:
    pacer = Pacer(10.0, 30.0)
    for k in range(4):
        at_ns = START_NS + k * 200 * MS
        pacer.arrived(at_ns)
        pacer.told(at_ns, 30 * MS)
    half = pacer.next_between()
    assert half is not None
    assert (half.at_ns - at_ns, half.due_ns - half.at_ns) == (100 * MS, 30 * MS)
    assert half.share == pytest.approx(0.5)
    pacer.told_between(half.at_ns)
    whole = pacer.next_between()
    assert whole is not None
    assert (whole.at_ns - at_ns, whole.due_ns - whole.at_ns) == (200 * MS, 80 * MS)
    pacer.told_between(whole.at_ns)
    assert pacer.next_between() is not None


def test_what_is_late_is_left_out_when_a_later_one_is_due() -> None:
    pacer = Pacer(10.0, 30.0)
    for k in range(4):
        at_ns = START_NS + k * 200 * MS
        pacer.arrived(at_ns)
        pacer.told(at_ns, 0)
    for now_ms, slot_ms in ((0, 100), (240, 100), (260, 200), (380, 300), (1149, 1000)):
        slot = pacer.next_between(at_ns + now_ms * MS)
        assert slot is not None
        assert slot.at_ns - at_ns == slot_ms * MS


@pytest.mark.parametrize("rate_hz", [10.0, 15.0, 20.0, 30.0])
def test_shares_between_two_frames_add_up_to_less_than_one_at_any_rate(rate_hz: float) -> None:
    pacer = Pacer(rate_hz, 30.0)
    for k in range(3):
        pacer.arrived(START_NS + k * 200 * MS)
        pacer.told(START_NS + k * 200 * MS, 0)
    shares = []
    while (
        slot := pacer.next_between()
    ) is not None and slot.at_ns < START_NS + 600 * MS - pacer.room_ns:
        shares.append(slot.share)
        pacer.told_between(slot.at_ns)
    assert len(shares) == round(rate_hz / 5.0) - 1
    assert sum(shares) == pytest.approx(1.0 - 5.0 / rate_hz)


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 15.0, 20.0, 30.0])
def test_frames_that_come_later_than_before_are_told_again_after_a_few(rate_hz: float) -> None:
    """What lies between overtakes the first of them, and has to wait for the others."""
    pacer = Pacer(10.0, 30.0)
    held_back = 0
    for k in range(round(20.0 * rate_hz)):
        at_ns = START_NS + round(k / rate_hz * 1e9)
        comes_ns = at_ns + (30 if k < 5.0 * rate_hz else 200) * MS
        while (slot := pacer.next_between(comes_ns)) is not None and slot.due_ns < comes_ns:
            pacer.told_between(slot.at_ns)
        pacer.arrived(at_ns)
        if pacer.holds_back(at_ns):
            pacer.held_back(comes_ns - at_ns)
            held_back += 1
        else:
            pacer.told(at_ns, comes_ns - at_ns)
    assert held_back <= 20
