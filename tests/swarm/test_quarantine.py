"""Who is quarantined and who is not: honest peers never, however unlucky; hostile ones soon."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcl_companion.swarm.quarantine import (
    Evidence,
    Quarantine,
    Quarantined,
    QuarantineOptions,
    Released,
)

OPTIONS = QuarantineOptions()
BAD, GOOD = Evidence.POSE_CONTRADICTED, Evidence.POSE_TAKEN
FLIGHT_S = 3600.0


def fly(
    quarantine: Quarantine, shares: dict[int, float], interval_s: float, seed: int
) -> dict[int, float]:
    """Have peers propose poses for an hour; return when each was quarantined, if it was."""
    rng = np.random.default_rng(seed)
    found: dict[int, float] = {}
    for now_s in np.arange(0.0, FLIGHT_S, interval_s):
        quarantine.poll(now_s)
        for peer, share in shares.items():
            evidence = BAD if rng.random() < share else GOOD
            term = quarantine.note(peer, evidence, "5.0 m from where we are", now_s)
            if term is not None:
                found.setdefault(peer, term.until_s - OPTIONS.first_s)
    return found


@settings(max_examples=30)
@given(st.integers(0, 10**9), st.floats(0.0, 0.05), st.sampled_from([0.3, 1.8, 10.0]))
def test_honest_peers_are_never_quarantined(seed: int, share: float, interval_s: float) -> None:
    """One in twenty of their poses is refused: an hour, alone or three together."""
    assert fly(Quarantine(OPTIONS), {2: share}, interval_s, seed) == {}
    assert fly(Quarantine(OPTIONS), {2: share, 3: share, 4: share}, interval_s, seed) == {}


@settings(max_examples=30)
@given(st.integers(0, 10**9), st.floats(0.8, 1.0), st.sampled_from([1.0, 1.8, 5.0]))
def test_a_hostile_peer_is_found_among_honest_ones(
    seed: int, share: float, interval_s: float
) -> None:
    found = fly(Quarantine(OPTIONS), {2: 0.03, 3: share, 4: 0.03}, interval_s, seed)
    assert set(found) == {3}
    assert 5.0 * interval_s <= found[3] <= 60.0 * interval_s


def test_several_that_contradict_us_at_once_are_not_held_to_be_wrong() -> None:
    """It is ours then that is off, by repeated structure for one."""
    quarantine = Quarantine(OPTIONS)
    for k in range(30):
        for peer in (2, 3):
            assert quarantine.note(peer, BAD, "far", 1.8 * k) is None


def test_what_our_own_jump_has_explained_counts_no_more() -> None:
    quarantine = Quarantine(OPTIONS)
    for k in range(4):
        quarantine.note(2, BAD, "far", 2.0 * k)
    quarantine.note(2, Evidence.MALFORMED, "bytes", 8.0)
    quarantine.forgive(BAD)
    terms = [quarantine.note(2, BAD, "far", 10.0 + 2.0 * k) for k in range(6)]
    # One for the bytes, and as many poses as ever.
    assert [term is not None for term in terms] == [False] * 5 + [True]


def test_two_maps_are_enough_and_one_is_not_and_old_evidence_is_none() -> None:
    quarantine = Quarantine(OPTIONS)
    wrong = Evidence.MAP_CONTRADICTED
    assert quarantine.note(1, wrong, "moved", 0.0) is None
    assert quarantine.note(1, wrong, "moved", OPTIONS.window_s + 0.1) is None
    quarantine.note(1, Evidence.MAP_TAKEN, "", OPTIONS.window_s + 1.0)
    assert quarantine.note(1, wrong, "moved", OPTIONS.window_s + 20.0) is None
    term = quarantine.note(1, wrong, "moved again", OPTIONS.window_s + 40.0)
    assert term == Quarantined(1, OPTIONS.window_s + 40.0 + OPTIONS.first_s, "moved again")
    assert (quarantine.why(1), quarantine.why(2)) == ("moved again", "")


def condemn(quarantine: Quarantine, now_s: float) -> Quarantined:
    for k in range(6):
        term = quarantine.note(3, BAD, "far", now_s + k)
    assert term is not None
    return term


def test_terms_grow_end_by_themselves_and_are_forgotten() -> None:
    quarantine = Quarantine(OPTIONS)
    now_s, lengths = 0.0, []
    for _ in range(8):
        term = condemn(quarantine, now_s)
        lengths.append(term.until_s - now_s - 5.0)
        assert quarantine.peers == {3}
        # What it says meanwhile is not judged, and nobody is released early.
        assert quarantine.note(3, Evidence.MAP_CONTRADICTED, "moved", now_s + 6.0) is None
        assert quarantine.poll(term.until_s - 0.1) == []
        assert quarantine.poll(term.until_s) == [Released(3)]
        assert quarantine.peers == frozenset()
        now_s = term.until_s + 1.0
    assert lengths == [60.0, 120.0, 240.0, 480.0, 960.0, 1800.0, 1800.0, 1800.0]
    assert quarantine.n_terms == {3: 8}
    later = condemn(quarantine, now_s + OPTIONS.forgotten_s)
    assert later.until_s - (now_s + OPTIONS.forgotten_s + 5.0) == OPTIONS.first_s


def test_a_burst_is_one_piece_of_evidence() -> None:
    quarantine = Quarantine(OPTIONS)
    assert all(
        quarantine.note(2, Evidence.MALFORMED, "bytes", 1e-3 * k) is None for k in range(900)
    )
    for k in range(1, 11):
        assert quarantine.note(2, Evidence.MALFORMED, "bytes", float(k)) is None
    assert quarantine.note(2, Evidence.MALFORMED, "bytes", 11.0) is not None


@given(st.integers(1, OPTIONS.flood_per_s // 2))
def test_only_a_flood_that_lasts_is_one(per_s: int) -> None:
    """Twice of what is said at most, as when the network repeats it, is none; nor is a burst."""
    quarantine = Quarantine(OPTIONS)
    for k in range(20 * per_s):
        assert quarantine.message(2, k / per_s) is None
    for _ in range(10_000):
        assert quarantine.message(2, 30.0) is None
    terms = [quarantine.message(3, k / 200.0) for k in range(200 * 15)]
    (term,) = (term for term in terms if term is not None)
    assert term.why == "more than 50 messages/s"


kinds = st.sampled_from(list(Evidence))


@given(st.lists(st.tuples(st.integers(1, 4), kinds, st.floats(0.0, 30.0)), max_size=200))
def test_any_evidence_in_any_order_ends_in_terms_that_end(
    said: list[tuple[int, Evidence, float]],
) -> None:
    quarantine = Quarantine(OPTIONS)
    now_s = 0.0
    for peer, evidence, pause_s in said:
        now_s += pause_s
        quarantine.poll(now_s)
        held = peer in quarantine.peers
        term = quarantine.note(peer, evidence, "why", now_s)
        assert (term is not None) == (peer in quarantine.peers and not held)
        assert term is None or now_s < term.until_s <= now_s + OPTIONS.longest_s
    quarantine.poll(now_s + OPTIONS.longest_s)
    assert quarantine.peers == frozenset()


@pytest.mark.parametrize("name", ["threshold", "window_s", "first_s", "flood_per_s"])
def test_options_that_make_no_sense_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        QuarantineOptions(**{name: 0})
