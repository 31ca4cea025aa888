"""What a second's course leads to, and how far ahead an update has to look."""

from __future__ import annotations

import pytest

from vcl_companion.swarm.foresight import UpdateTime, foreseen

NOW_S, WINDOW_S, AHEAD_S = 5.0, 1.5, 2.0
# Five looks in each third of the window; the newest third's median is of 0.25 s ago.
TIMES_S = [NOW_S - 0.05 - 0.1 * k for k in range(14, -1, -1)]
NEWEST_S, THIRD_S = NOW_S - 0.25, 0.5


def there(values: list[float], times_s: list[float] = TIMES_S) -> float | None:
    """What is foreseen of such values."""
    return foreseen(list(zip(times_s, values, strict=True)), NOW_S, WINDOW_S, AHEAD_S)


@pytest.mark.parametrize("rate", [-30.0, 30.0])
def test_a_steady_course_goes_on(rate: float) -> None:
    found = there([rate * at_s for at_s in TIMES_S])
    assert found == pytest.approx(rate * (NEWEST_S + AHEAD_S))


def test_the_slower_of_two_steps_is_followed() -> None:
    for steps in ((0.0, 8.0, 10.0), (0.0, 2.0, 10.0)):
        found = there([value for value in steps for _ in range(5)])
        assert found == pytest.approx(10.0 + 2.0 * AHEAD_S / THIRD_S)


def test_what_stands_or_turns_back_or_was_just_begun_goes_nowhere() -> None:
    assert there([7.0] * 15) is None
    assert there([7.0] * 5 + [8.0] * 5 + [7.0] * 5) is None
    assert there([7.0] * 10 + [9.0] * 5) is None
    late_s = TIMES_S[3:]
    assert there(late_s, late_s) is None


def test_as_far_as_the_last_update_took_from_the_majoritys_wish_to_the_map() -> None:
    took = UpdateTime()
    took.follow(b"first", True, False, 0.0)  # the wish for it was not seen to begin
    assert took.ahead_s(2.0) == 2.0
    took.follow(b"first", True, False, 1.0)
    took.follow(b"first", False, True, 2.0)  # those who have it want no other
    took.follow(b"second", False, False, 4.0)
    assert took.ahead_s(2.0) == 3.0
    assert took.ahead_s(1.0) == 2.0  # twice as far at most


def test_a_wish_that_was_given_up_does_not_count() -> None:
    took = UpdateTime()
    took.follow(b"first", False, False, 0.0)
    took.follow(b"first", True, False, 1.0)
    took.follow(b"first", False, False, 2.0)
    took.follow(b"second", False, False, 9.0)
    assert took.ahead_s(2.0) == 2.0
