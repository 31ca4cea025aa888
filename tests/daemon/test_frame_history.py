"""The frames that peers may still ask for."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.frame_history import FrameHistory

MS = 1_000_000


def frame(at_ms: int) -> Frame:
    return Frame(np.zeros((2, 3), np.uint8), at_ms * MS, 0, 0)


def nearest_ms(history: FrameHistory, at_ms: int) -> int | None:
    found = history.nearest(at_ms * MS)
    return None if found is None else found.captured_at_ns // MS


def test_without_frames_there_is_none() -> None:
    assert FrameHistory().newest is None
    assert FrameHistory().nearest(0) is None


def test_the_nearest_is_found_before_between_and_after() -> None:
    history = FrameHistory()
    for at_ms in (1000, 1200, 1400):
        history.add(frame(at_ms))
    asked = (500, 1000, 1099, 1101, 1390, 2000)
    assert [nearest_ms(history, at_ms) for at_ms in asked] == [1000, 1000, 1000, 1200, 1400, 1400]


def test_a_frame_of_another_moment_is_none() -> None:
    history = FrameHistory()
    history.add(frame(5000))
    assert [nearest_ms(history, at_ms) for at_ms in (3999, 4000, 6000, 6001)] == [
        None, 5000, 5000, None,
    ]  # fmt: skip


@pytest.mark.parametrize("rate_hz", [5, 30, 120])
def test_what_was_asked_for_a_second_ago_is_still_here(rate_hz: int) -> None:
    history = FrameHistory()
    period_ms = 1000 / rate_hz
    for k in range(10 * rate_hz):
        history.add(frame(round(k * period_ms)))
    now_ms = round((10 * rate_hz - 1) * period_ms)
    assert nearest_ms(history, now_ms) == now_ms
    for ago_ms in range(0, 1900, 37):
        found_ms = nearest_ms(history, now_ms - ago_ms)
        assert found_ms is not None
        assert abs(now_ms - ago_ms - found_ms) <= max(period_ms / 2 + 1, 60)


def test_of_the_ten_seconds_before_about_one_a_second_is_here() -> None:
    history = FrameHistory()
    for at_ms in range(0, 30_000, 100):
        history.add(frame(at_ms))
    for ago_ms in range(0, 10_000, 170):
        found_ms = nearest_ms(history, 29_900 - ago_ms)
        assert found_ms is not None
        assert abs(29_900 - ago_ms - found_ms) <= 500
    assert nearest_ms(history, 29_900 - 14_000) is None


def test_what_a_map_may_be_made_of_is_here_until_the_next_and_what_came_since() -> None:
    history = FrameHistory()
    given = frame(0)
    for at_ms in range(0, 11_000, 100):
        history.add(given if at_ms == 0 else frame(at_ms))
        if at_ms == 0:
            history.gave(given)
    assert history.has(0)
    assert [f.captured_at_ns for f in history.after(-1)].count(0) == 1
    since = [f.captured_at_ns // MS for f in history.after(0)]
    assert max(np.diff([0, *since])) <= 200
    history.gave(frame(10_900))
    for at_ms in range(11_000, 40_000, 100):
        history.add(frame(at_ms))
    assert not history.has(0)
    assert history.has(10_900 * MS)


def test_it_does_not_grow() -> None:
    history = FrameHistory()
    for k in range(1000):
        history.add(frame(100 * k))
    oldest = [at_ms for at_ms in range(0, 100_000, 100) if nearest_ms(history, at_ms) == at_ms]
    assert 30 <= len(oldest) <= 36


@pytest.mark.parametrize("rate_hz", [5, 30])
def test_of_who_is_lost_five_frames_a_second_are_here_since_the_last_fix(rate_hz: int) -> None:
    history = FrameHistory()
    for at_ms in range(0, 12_000, 1000 // rate_hz):
        history.add(frame(at_ms), min(at_ms, 2000) * MS)
    kept_ms = [f.captured_at_ns // MS for f in history.after(2000 * MS)]
    assert max(np.diff([2000, *kept_ms])) <= 200 + 1000 // rate_hz
    assert len(kept_ms) < 75
    assert all(history.has(at_ms * MS) for at_ms in kept_ms)
    assert not history.has(2001 * MS)
    # Found again it is as for any other.
    for at_ms in range(12_000, 12_500, 1000 // rate_hz):
        history.add(frame(at_ms), at_ms * MS)
    assert len(history.after(0)) <= 24 + 10
