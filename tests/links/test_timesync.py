"""The offset of two clocks, from exchanges over links that are slow, jittery or cut."""

import numpy as np
import pytest

from vcl_companion.links.timesync import TimesyncEstimator

SECOND = 1_000_000_000
MS = 1_000_000


class Line:
    """A line to an autopilot whose clock is ours minus ``offset_ns``."""

    def __init__(self, offset_ns: int) -> None:
        self.offset_ns = offset_ns
        self.estimator = TimesyncEstimator()

    def exchange(self, now_ns: int, there_ns: int = 0, back_ns: int = 0) -> str | None:
        ts1_ns = self.estimator.ask(now_ns)
        tc1_ns = now_ns + there_ns - self.offset_ns
        return self.estimator.answered(ts1_ns, tc1_ns, now_ns + there_ns + back_ns)


def test_an_even_line_gives_the_exact_offset() -> None:
    line = Line(987_654_321)
    assert line.estimator.offset_ns(5 * SECOND) is None
    assert line.estimator.round_trip_s is None
    for k in range(5):
        assert line.exchange((5 + k) * SECOND, 4 * MS, 4 * MS) is None
    assert line.estimator.offset_ns(9 * SECOND) == 987_654_321
    assert line.estimator.round_trip_s == pytest.approx(0.008)
    assert line.estimator.n_exchanges == 5


def test_jitter_costs_less_than_half_of_its_median() -> None:
    rng = np.random.default_rng(3)
    line = Line(-3 * SECOND)
    errors_ns = []
    for k in range(200):
        there_ns, back_ns = (MS + rng.exponential(5 * MS, 2)).astype(int).tolist()
        line.exchange((10 + k) * SECOND, there_ns, back_ns)
        if k > 20:
            offset_ns = line.estimator.offset_ns((10 + k) * SECOND)
            assert offset_ns is not None
            errors_ns.append(offset_ns - line.offset_ns)
    rms_ms = float(np.sqrt(np.mean(np.square(errors_ns)))) / MS
    # One exchange alone errs by 5 ms / sqrt(2) = 3.5 ms rms.
    assert 0.2 < rms_ms < 1.75


def test_single_wrong_answers_do_not_move_it() -> None:
    line = Line(SECOND)
    for k in range(40):
        line.offset_ns = SECOND + (200 * MS if k % 4 == 3 else 0)
        line.exchange((10 + k) * SECOND)
    assert line.estimator.offset_ns(50 * SECOND) == SECOND
    # Deviations too small to be called jumps are outvoted as well.
    for k in range(40):
        line.offset_ns = SECOND + (20 * MS if k % 4 == 3 else 0)
        line.exchange((50 + k) * SECOND)
    assert line.estimator.offset_ns(90 * SECOND) == SECOND


def test_a_reboot_starts_anew_at_once() -> None:
    line = Line(SECOND)
    for k in range(16):
        line.exchange((100 + k) * SECOND)
    line.offset_ns = 115 * SECOND
    assert line.exchange(116 * SECOND) is None
    assert line.estimator.offset_ns(116 * SECOND) == 115 * SECOND
    assert line.estimator.n_exchanges == 1


def test_a_clock_that_stepped_forward_is_believed_after_five() -> None:
    line = Line(100 * SECOND)
    for k in range(16):
        line.exchange((200 + k) * SECOND)
    line.offset_ns = 90 * SECOND
    seen = []
    for k in range(6):
        line.exchange((216 + k) * SECOND)
        seen.append(line.estimator.offset_ns((216 + k) * SECOND))
    assert seen == [100 * SECOND] * 4 + [90 * SECOND] * 2


def test_an_old_estimate_is_none_and_is_replaced_by_the_next() -> None:
    line = Line(SECOND)
    line.exchange(10 * SECOND)
    assert line.estimator.offset_ns(39 * SECOND) == SECOND
    assert line.estimator.offset_ns(41 * SECOND) is None
    line.offset_ns = 7 * SECOND
    line.exchange(1000 * SECOND)
    assert line.estimator.offset_ns(1000 * SECOND) == 7 * SECOND


def test_answers_to_no_question_are_refused() -> None:
    line = Line(SECOND)
    assert line.estimator.answered(5, 6, 7) == "timesync answer to no question"
    ts1_ns = line.estimator.ask(10 * SECOND)
    assert line.estimator.answered(ts1_ns, 0, 10 * SECOND) == "timesync answer without a time"
    ts1_ns = line.estimator.ask(10 * SECOND)
    assert line.estimator.answered(ts1_ns, 5, 12 * SECOND) == "timesync answer too late"
    ts1_ns = line.estimator.ask(13 * SECOND)
    assert line.estimator.answered(ts1_ns, 5, 13 * SECOND) is None
    assert line.estimator.answered(ts1_ns, 5, 13 * SECOND) == "timesync answer to no question"
    assert line.estimator.n_exchanges == 1


def test_questions_are_told_apart_even_while_time_stands_still() -> None:
    line = Line(SECOND)
    asked = [line.estimator.ask(5 * SECOND) for _ in range(100)]
    assert len(set(asked)) == 100
    assert line.estimator.unanswered == 100
    # Only the last ones are still waited for.
    assert line.estimator.answered(asked[0], 4 * SECOND, 5 * SECOND) is not None
    assert line.estimator.answered(asked[-1], 4 * SECOND, 5 * SECOND) is None
    assert line.estimator.unanswered == 0
    assert line.estimator.offset_ns(5 * SECOND) == SECOND
