"""A peer's clock: the truth within the stated bound, whatever the link and the peer do."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcl_companion.swarm.peer_time import MAX_DRIFT, ClockRelation, PeerTime

SECOND = 1_000_000_000
MS = 1_000_000


@dataclass
class Peer:
    """A clock that was started at another time, and drifts, ``drift`` of ours beside it.

    The drift swings by ``swing`` to either side within six minutes.
    """

    offset_ns: int
    drift: float = 0.0
    time: PeerTime = field(default_factory=PeerTime)
    swing: float = 0.0

    def true_offset_ns(self, at_ns: int) -> float:
        """Our clock minus the peer's, at an instant of ours."""
        swung_ns = self.swing * 60 * SECOND * (1 - math.cos(at_ns / (60 * SECOND)))
        return self.offset_ns + self.drift * at_ns + swung_ns

    def reads(self, at_ns: int) -> int:
        """What the peer's clock shows at an instant of ours."""
        return round(at_ns - self.true_offset_ns(at_ns))

    def exchange(self, now_ns: int, there_ns: int = 0, back_ns: int = 0) -> str | None:
        ts1_ns = self.time.ask(now_ns)
        tc1_ns = self.reads(now_ns + there_ns)
        return self.time.answered(ts1_ns, tc1_ns, now_ns + there_ns + back_ns)

    def known(self, at_ns: int) -> ClockRelation:
        relation = self.time.relation(at_ns)
        assert relation is not None
        return relation

    def assert_within_bound(self, at_ns: int) -> ClockRelation:
        relation = self.known(at_ns)
        assert abs(relation.offset_ns - self.true_offset_ns(at_ns)) <= relation.bound_ns
        return relation


def test_nothing_is_known_before_the_first_answer() -> None:
    peer = Peer(-5 * SECOND)
    assert peer.time.relation(SECOND) is None
    assert peer.time.instant(5, 0.5, SECOND).bound_ns is None
    assert peer.time.instant(5, 0.5, SECOND).at_ns == SECOND // 2
    peer.time.ask(SECOND)
    assert peer.time.relation(SECOND) is None


def test_an_even_line_gives_the_offset_and_then_the_drift() -> None:
    peer = Peer(-987_654_321_000, 40e-6)
    assert peer.exchange(10 * SECOND, MS, MS) is None
    first = peer.assert_within_bound(10 * SECOND)
    assert MS <= first.bound_ns < 1.1 * MS
    assert first.drift_bound == MAX_DRIFT
    for k in range(1, 30):
        peer.exchange((10 + 8 * k) * SECOND, MS, MS)
    last = peer.assert_within_bound(242 * SECOND)
    assert abs(last.drift - 40e-6) <= last.drift_bound < 20e-6
    assert last.bound_ns < 1.1 * MS
    # An answer of a minute ago still says much, with the drift known.
    later = peer.assert_within_bound(302 * SECOND)
    assert last.bound_ns < later.bound_ns < 3 * MS


def test_a_drift_that_changes_with_the_temperature_stays_within_the_bound() -> None:
    peer = Peer(-9 * SECOND, 30e-6, swing=4e-6)
    for k in range(100):
        assert peer.exchange((10 + 8 * k) * SECOND, 5000, 5000) is None
        for later_s in (0, 4, 8):
            known = peer.assert_within_bound((10 + 8 * k + later_s) * SECOND)
    assert known.bound_ns < MS / 2


@dataclass(frozen=True)
class Line:
    """A link: fixed ways, jitter on top, and what it does to datagrams; times in seconds."""

    there_s: float
    back_s: float
    jitter_s: float
    loss: float
    twice: float


lines = st.builds(
    Line,
    there_s=st.sampled_from([0.0, 0.001, 0.05, 2.0]),
    back_s=st.sampled_from([0.0, 0.001, 0.3, 2.5]),
    jitter_s=st.sampled_from([0.0, 0.002, 0.5, 3.0]),
    loss=st.sampled_from([0.0, 0.3, 0.7]),
    twice=st.sampled_from([0.0, 0.5]),
)


@given(
    lines,
    st.integers(-(10**15), 10**15),
    st.floats(-150e-6, 150e-6),
    st.floats(-4e-6, 4e-6),
    st.integers(0, 2**32),
)
@settings(max_examples=150, deadline=None)
def test_the_truth_lies_within_the_bound(
    line: Line, offset_ns: int, drift: float, wander: float, seed: int
) -> None:
    """Whatever is delayed, overtaken, lost or doubled; the drift itself changes a little."""
    rng = np.random.default_rng(seed)
    peer = Peer(offset_ns, drift, swing=wander)
    time = peer.time
    start_ns = 1000 * SECOND

    def way_ns(fixed_s: float) -> int:
        return round((fixed_s + rng.exponential(line.jitter_s)) * SECOND)

    answers: list[tuple[int, int, int]] = []
    n_known = 0
    for k in range(60):
        now_ns = start_ns + round((0.5 * min(k, 4) + 8.0 * max(k - 4, 0)) * SECOND)
        while answers and answers[0][0] <= now_ns:
            came_ns, ts1_ns, tc1_ns = heapq.heappop(answers)
            refusal = time.answered(ts1_ns, tc1_ns, came_ns)
            assert refusal != "timesync answer that does not fit the others"
        for at_ns in (now_ns, now_ns - SECOND):
            relation = time.relation(at_ns)
            if relation is not None:
                n_known += 1
                peer.assert_within_bound(at_ns)
                assert abs(relation.drift - drift) <= relation.drift_bound + 2 * abs(wander)
        ts1_ns = time.ask(now_ns)
        if rng.uniform() < line.loss:
            continue
        there_ns = now_ns + way_ns(line.there_s)
        tc1_ns = peer.reads(there_ns)
        if tc1_ns <= 0:
            continue  # a peer whose clock has not begun says nothing
        for _ in range(1 + (rng.uniform() < line.twice)):
            heapq.heappush(answers, (there_ns + way_ns(line.back_s), ts1_ns, tc1_ns))
    slow = line.there_s + line.back_s + line.jitter_s > 4.0 or line.loss > 0.5
    assert n_known > 50 or slow or offset_ns > start_ns - 600 * SECOND


def test_uneven_ways_cost_at_most_half_of_the_round_trip() -> None:
    peer = Peer(-7 * SECOND)
    for k in range(20):
        peer.exchange((10 + k) * SECOND, 0, 2 * SECOND)
    assert SECOND <= peer.assert_within_bound(31 * SECOND).bound_ns < 1.01 * SECOND


def test_one_quick_exchange_decides_among_slow_ones() -> None:
    peer = Peer(3 * SECOND, -60e-6)
    for k in range(20):
        peer.exchange((10 + 8 * k) * SECOND, *((MS, MS) if k == 9 else (SECOND, 3 * SECOND)))
    # Ten intervals old, of a drift that the slow ones say little of.
    assert peer.assert_within_bound(165 * SECOND).bound_ns < 20 * MS


def test_a_peer_with_another_clock_is_believed_soon_and_before_that_nothing_is() -> None:
    peer = Peer(5 * SECOND)
    for k in range(20):
        peer.exchange((10 + k) * SECOND, MS, MS)
    assert peer.time.is_settled
    peer.offset_ns = 29 * SECOND  # restarted a second ago
    seen = []
    for k in range(4):
        peer.exchange((30 + k) * SECOND, MS, MS)
        relation = peer.time.relation((30 + k) * SECOND)
        seen.append(None if relation is None else round(relation.offset_ns / SECOND))
    assert seen == [None, None, 29, 29]
    assert peer.time.n_epochs == 2
    peer.assert_within_bound(33 * SECOND)


def test_a_peer_that_was_away_has_to_answer_first() -> None:
    peer = Peer(5 * SECOND)
    for k in range(10):
        peer.exchange((10 + k) * SECOND, MS, MS)
    peer.time.rejoined()
    assert peer.time.relation(20 * SECOND) is None
    assert not peer.time.is_settled
    peer.exchange(20 * SECOND, SECOND, SECOND)
    # It has the same clock still, and what was known of that holds.
    assert peer.assert_within_bound(22 * SECOND).bound_ns < 3 * MS
    assert peer.time.n_epochs == 1


def test_who_is_silent_for_long_is_not_known_any_more() -> None:
    peer = Peer(5 * SECOND)
    peer.exchange(10 * SECOND, MS, MS)
    assert peer.time.relation(129 * SECOND) is not None
    assert peer.time.relation(131 * SECOND) is None


def test_one_wrong_answer_moves_nothing() -> None:
    peer = Peer(5 * SECOND)
    for k in range(10):
        peer.exchange((10 + k) * SECOND, MS, MS)
    for wrong_ns in (1, 5 * MS, 10**6 * SECOND, 2**63 - 1):
        ts1_ns = peer.time.ask(21 * SECOND)
        assert peer.time.answered(ts1_ns, wrong_ns, 21 * SECOND) is not None
        assert peer.time.relation(21 * SECOND) is None  # it might be another clock
        assert peer.exchange(22 * SECOND, MS, MS) is None
        assert peer.assert_within_bound(22 * SECOND).bound_ns < 3 * MS
    assert peer.time.n_epochs == 1


def test_answers_to_no_question_are_refused() -> None:
    peer = Peer(5 * SECOND)
    assert peer.time.answered(5, 6, 7) == "timesync answer to no question"
    ts1_ns = peer.time.ask(10 * SECOND)
    assert peer.time.answered(ts1_ns, 5 * SECOND, 10 * SECOND) is None
    for tc1_ns in (5 * SECOND, 9 * SECOND):
        again = peer.time.answered(ts1_ns, tc1_ns, 10 * SECOND)
        assert again == "timesync answer to no question"
    ts1_ns = peer.time.ask(10 * SECOND)
    assert peer.time.answered(ts1_ns, -5, 11 * SECOND) == "timesync answer without a time"
    ts1_ns = peer.time.ask(10 * SECOND)
    assert peer.time.answered(ts1_ns, 5 * SECOND, 21 * SECOND) == "timesync answer too late"


_int64 = st.integers(-(1 << 63), (1 << 63) - 1)


@given(st.lists(st.tuples(_int64, st.booleans()), max_size=40), st.integers(0, 2**32))
@settings(max_examples=100, deadline=None)
def test_whatever_is_answered_it_never_raises_and_is_never_off_by_more_than_it_says(
    lies: list[tuple[int, bool]], seed: int
) -> None:
    """True answers and at most one lie between them, of any time, some to no question."""
    rng = np.random.default_rng(seed)
    peer = Peer(-50 * SECOND, 30e-6)
    now_ns = 100 * SECOND
    for number, is_to_a_question in [*lies, (7, True)]:
        for _ in range(2):
            now_ns += 8 * SECOND
            peer.exchange(now_ns, *(int(ns) for ns in rng.integers(0, 50 * MS, 2)))
            peer.assert_within_bound(now_ns)
        truth_ns = peer.reads(now_ns)
        if abs(number - truth_ns) > SECOND:  # not a lie that could be true
            ts1_ns = peer.time.ask(now_ns) if is_to_a_question else number
            assert peer.time.answered(ts1_ns, number, now_ns) is not None
        peer.time.instant(number, 3.0, now_ns)
        relation = peer.time.relation(number)
        assert relation is None or abs(relation.at_ns - now_ns) < 200 * SECOND
    assert peer.time.n_epochs == 1


def test_an_instant_is_converted_whatever_time_the_message_took() -> None:
    peer = Peer(77 * SECOND, 20e-6)
    for k in range(6):
        peer.exchange((100 + 8 * k) * SECOND, 5 * MS, MS)
    truth_ns = 141 * SECOND
    for way_s in (0.0, 0.3, 2.0, 30.0):
        came_ns = truth_ns + round((0.25 + way_s) * SECOND)
        instant = peer.time.instant(peer.reads(truth_ns), 0.25, came_ns)
        assert instant.bound_ns is not None
        assert abs(instant.at_ns - truth_ns) <= instant.bound_ns < 5 * MS


@pytest.mark.parametrize("lie_s", [-3600.0, 0.2, 3600.0])
def test_an_instant_that_its_age_speaks_against_goes_by_the_age(lie_s: float) -> None:
    peer = Peer(77 * SECOND)
    peer.exchange(100 * SECOND, MS, MS)
    said_ns = peer.reads(101 * SECOND) + round(lie_s * SECOND)
    instant = peer.time.instant(said_ns, 0.5, 101 * SECOND + SECOND // 2)
    assert (instant.at_ns, instant.bound_ns) == (101 * SECOND, None)


def test_clocks_known_to_no_second_are_not_related() -> None:
    peer = Peer(77 * SECOND)
    peer.exchange(100 * SECOND, 0, 4 * SECOND)
    assert peer.assert_within_bound(104 * SECOND).bound_ns >= 2 * SECOND
    assert peer.time.instant(peer.reads(104 * SECOND), 0.0, 105 * SECOND).bound_ns is None


@given(st.lists(st.integers(1, 60), min_size=5, max_size=40), st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_clocks_that_are_told_the_time_now_and_then_stay_within_the_bound(
    steps_ms: list[int], seed: int
) -> None:
    """Both show one time, each as it was told last: question and answer take none of it."""
    rng = np.random.default_rng(seed)
    time = PeerTime(resolution_ns=100 * MS)
    at_ns = 50 * SECOND
    for step_ms in steps_ms:
        at_ns += step_ms * MS
        ours_ns, theirs_ns = (at_ns - int(lag) for lag in rng.integers(0, 99 * MS, 2))
        assert time.answered(time.ask(ours_ns), theirs_ns, ours_ns) is None
        relation = time.relation(ours_ns)
        assert relation is not None
        assert abs(relation.offset_ns) <= relation.bound_ns <= 101 * MS
