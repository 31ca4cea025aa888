"""What a drone sees of its map, lately and soon, and when it votes for a new one."""

from __future__ import annotations

from dataclasses import replace

import pytest

from vcl_companion.swarm.own_vote import OwnVote, Sight
from vcl_companion.swarm.update_options import UpdateOptions

# Long against a step of these tests.
OPTIONS = UpdateOptions(hold_s=0.5, interval_s=1.0)
STEP_S = 0.1
FIRST, SECOND = b"revision", b"the next"
PLENTY, FEW = 400, 20


def voted(seen: list[int], revision: bytes = FIRST, options: UpdateOptions = OPTIONS) -> bool:
    """The vote after so many tenths of a second of what is seen."""
    vote = OwnVote(options)
    return [vote.look(revision, Sight(n), k * STEP_S) for k, n in enumerate(seen)][-1]


def test_who_sees_few_landmarks_votes_and_who_sees_many_does_not() -> None:
    assert voted([OPTIONS.tracked - 1] * 30)
    assert not voted([OPTIONS.tracked] * 30)
    assert voted([0] * 30)  # lost


def test_who_has_lost_half_of_what_it_saw_votes() -> None:
    share = round(OPTIONS.share * PLENTY)
    assert voted([PLENTY] * 30 + [share - 1] * 30)
    assert not voted([PLENTY] * 30 + [share] * 30)
    assert not voted([share - 1] * 30)  # it never saw more of this one


def test_of_more_than_enough_the_loss_is_none() -> None:
    many = 5 * OPTIONS.enough
    assert not voted([many] * 30 + [round(OPTIONS.share * OPTIONS.enough)] * 30)
    assert voted([many] * 30 + [round(OPTIONS.share * OPTIONS.enough) - 1] * 30)


def test_one_bad_frame_changes_nothing() -> None:
    assert not voted([PLENTY] * 20 + [0, 0])
    assert voted([FEW] * 20 + [PLENTY, PLENTY])
    # Nor does one frame that saw very many raise what is expected of all later ones.
    assert not voted([PLENTY] * 20 + [1500, 1500] + [PLENTY] * 20)


def test_a_hundred_looks_in_a_moment_count_as_a_few() -> None:
    vote = OwnVote(OPTIONS)
    times = [0.1 * k for k in range(20)] + [1.95 + 0.001 * k for k in range(100)]
    sights = [PLENTY] * 20 + [0] * 100
    votes = [vote.look(FIRST, Sight(n), at_s) for at_s, n in zip(times, sights, strict=True)]
    assert not any(votes)
    assert any(vote.look(FIRST, Sight(0), 2.1 + 0.1 * k) for k in range(8))


def test_who_will_have_lost_half_when_an_update_is_there_votes_before() -> None:
    """Sixty landmarks a second: below 0.6 of 400 after 2.7 s, foreseen when that is a course."""
    falling = [PLENTY] * 20 + [PLENTY - 6 * k for k in range(40)]
    votes = [voted(falling[: 20 + k]) for k in range(1, 40)]
    assert not any(votes[:9])
    assert all(votes[12:])
    # A course that is none: a step, however steep, and coming and going.
    assert not voted([PLENTY] * 20 + [PLENTY - 100] * 10)
    assert not any(voted([PLENTY - 50 * (k % 3 == n % 3) for k in range(n)]) for n in range(1, 40))


@pytest.mark.parametrize(
    ("took_s", "foreseen_s"), [(0.5, 2.0), (2.0, 2.0), (3.0, 3.0), (4.0, 4.0), (30.0, 4.0)]
)
@pytest.mark.parametrize("on_its_way", [0.0, 0.6])
def test_what_takes_longer_is_foreseen_earlier(
    took_s: float, foreseen_s: float, on_its_way: float
) -> None:
    """Twenty landmarks a second: 240 are left after 8 s, and that is known so long before."""
    vote = OwnVote(OPTIONS)
    now_s = 0.0

    def look(revision: bytes, tracked: float, is_wanted: bool = False) -> bool:
        nonlocal now_s
        now_s += STEP_S
        vote.follow(revision, is_wanted, False, now_s)
        return vote.look(revision, Sight(round(tracked)), now_s)

    while not look(FIRST, FEW):
        pass
    for _ in range(50):  # alone: as long as the others are content nothing is taken long over
        assert look(FIRST, FEW)
    on_its_way_s = took_s * on_its_way
    for _ in range(round((took_s - on_its_way_s) / STEP_S)):
        assert look(FIRST, FEW, is_wanted=True)
    # Who made the map flies on it and tells so, which ends the wish, before all others have it.
    for _ in range(round(on_its_way_s / STEP_S)):
        now_s += STEP_S
        vote.follow(FIRST, False, True, now_s)
    # As a daemon does: the map is there before a frame has been looked at on it, and for a moment
    # the others' wishes are those of before.
    now_s += STEP_S
    vote.follow(SECOND, True, False, now_s)
    assert vote.unseen() is False
    for _ in range(20):
        wants = look(SECOND, PLENTY)
    assert not wants
    n_steps = next(k for k in range(100) if look(SECOND, PLENTY - 2.0 * k))
    # The newest third of the window stands for where it is, and the thirds have to agree.
    assert 8.0 - n_steps * STEP_S == pytest.approx(foreseen_s - 0.4, abs=0.3)


def test_what_fills_less_and_less_and_what_looks_ever_newer_is_foreseen() -> None:
    def seen(sights: list[Sight]) -> bool:
        vote = OwnVote(OPTIONS)
        return [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(sights)][-1]

    still = [Sight(PLENTY, 0.95, 0.001, 1.0)] * 20
    assert not seen(still)
    assert seen(still + [Sight(PLENTY, 0.95 - 0.02 * k, 0.001, 1.0) for k in range(12)])
    assert seen(still + [Sight(PLENTY, 0.95, 0.001, 1.0 + 0.3 * k) for k in range(12)])
    assert not seen(still + [Sight(PLENTY, 0.95, 0.001, 1.0 + 0.18 * k) for k in range(12)])
    assert not seen(still + [Sight(PLENTY, 0.95 - 0.002 * k, 0.001, 1.0) for k in range(12)])


@pytest.mark.parametrize(("there_deg", "votes"), [(7.5, False), (8.5, True), (None, True)])
def test_what_looks_ever_newer_is_no_news_on_the_way_to_a_place_that_the_map_knows(
    there_deg: float | None, votes: bool
) -> None:
    asked: list[float] = []

    def ahead(ahead_s: float) -> float | None:
        asked.append(ahead_s)
        return there_deg

    vote = OwnVote(OPTIONS, ahead)
    newer = [1.0] * 20 + [1.0 + 0.3 * k for k in range(12)]
    seen = [Sight(PLENTY, 0.95, 0.001, novelty) for novelty in newer]
    assert [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(seen)][-1] is votes
    assert set(asked) == {OPTIONS.ahead_s}
    # Here it is new already, whatever comes.
    here = [Sight(PLENTY, 0.95, 0.001, OPTIONS.novelty_deg + 0.1)] * 20
    assert [vote.look(FIRST, sight, 4.0 + k * STEP_S) for k, sight in enumerate(here)][-1]


@pytest.mark.parametrize(("share", "votes"), [(0.7, False), (0.5, True), (None, False)])
def test_who_turns_away_from_a_new_map_votes_before_its_loss_is_a_course(
    share: float | None, votes: bool
) -> None:
    asked: list[float] = []

    def ahead(ahead_s: float) -> float | None:
        asked.append(ahead_s)
        return share

    vote = OwnVote(OPTIONS, share_ahead=ahead)
    seen = [vote.look(FIRST, Sight(PLENTY), k * STEP_S) for k in range(10)]
    assert not any(seen[:2])
    assert all(voted is votes for voted in seen[2:])
    assert set(asked) == {OPTIONS.ahead_s}
    # From then on the landmarks that are seen tell.
    n_asked = len(asked)
    assert not [vote.look(FIRST, Sight(PLENTY), 1.0 + k * STEP_S) for k in range(10)][-1]
    assert len(asked) == n_asked


def test_a_vote_stands_until_the_new_map_has_been_seen_for_a_while() -> None:
    vote = OwnVote(OPTIONS)
    for k in range(20):
        vote.look(FIRST, Sight(PLENTY), k * STEP_S)
    assert vote.look(FIRST, Sight(FEW), 2.0) is False
    assert [vote.look(FIRST, Sight(FEW), 2.1 + k * STEP_S) for k in range(10)][-1]
    assert vote.look(SECOND, Sight(PLENTY), 3.2)
    assert not [vote.look(SECOND, Sight(PLENTY), 3.3 + k * STEP_S) for k in range(6)][-1]


def test_a_map_that_is_behind_when_it_comes_is_voted_on_soon() -> None:
    vote = OwnVote(OPTIONS)
    new = Sight(PLENTY, novelty_deg=1.1 * OPTIONS.novelty_deg)
    for k in range(20):
        vote.look(FIRST, Sight(PLENTY), k * STEP_S)
    votes = [vote.look(SECOND, new, 2.0 + k * STEP_S) for k in range(4)]
    assert votes == [False, False, True, True]


def test_without_a_map_or_with_updates_turned_off_nobody_votes() -> None:
    assert not voted([0] * 30, b"")
    assert not voted([0] * 30, options=replace(OPTIONS, tracked=0, share=0.0))


def test_a_vote_stands_for_half_a_second_after_its_reason() -> None:
    vote = OwnVote(OPTIONS)
    wide, narrow = (Sight(PLENTY, OPTIONS.covered + d) for d in (0.2, -0.05))
    sights = [wide] * 20 + [narrow] * 10 + [wide] * 20
    votes = [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(sights)]
    begins, ends = votes.index(True), len(votes) - votes[::-1].index(True)
    assert all(votes[begins:ends])
    # By the window's median it begins and ends half a second late, and then it stands.
    assert 25 <= begins <= 26
    assert 39 <= ends <= 41
    # What hovers about a bound is one vote, though the reason comes and goes.
    sights = [wide] * 20 + ([narrow] * 7 + [wide] * 5) * 6
    vote = OwnVote(OPTIONS)
    votes = [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(sights)]
    assert all(votes[votes.index(True) :])


def judged(sights: list[Sight]) -> bool:
    """The vote after so many tenths of a second of what is seen."""
    vote = OwnVote(OPTIONS)
    return [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(sights)][-1]


def test_who_sees_the_map_in_a_corner_of_the_image_only_votes() -> None:
    wide, narrow = (Sight(PLENTY, OPTIONS.covered + d) for d in (0.2, -0.05))
    assert judged([wide] * 20 + [narrow] * 20)
    assert not judged([wide] * 40)
    assert not judged([narrow] * 40)  # the sky never covers more


def test_a_corner_with_many_landmarks_does_as_much_as_all_of_the_image_with_few() -> None:
    def votes(tracked: int, covered: float) -> bool:
        vote = OwnVote(OPTIONS)
        seen = [Sight(tracked, 1.0)] * 20 + [Sight(tracked, covered)] * 30
        return [vote.look(FIRST, sight, k * STEP_S) for k, sight in enumerate(seen)][-1]

    half = 0.5 * OPTIONS.covered
    assert votes(OPTIONS.enough, OPTIONS.covered - 0.01)
    assert not votes(OPTIONS.enough, OPTIONS.covered)
    assert votes(OPTIONS.tracked, OPTIONS.covered - 0.01)  # of fewer no more is asked for
    assert votes(4 * OPTIONS.enough, half - 0.01)
    assert not votes(4 * OPTIONS.enough, half)


def test_who_knows_its_place_twice_worse_than_at_best_votes() -> None:
    sure = Sight(PLENTY, None, 3.0 * OPTIONS.sigma_m)
    worse = Sight(PLENTY, None, 1.01 * OPTIONS.sigma_growth * 3.0 * OPTIONS.sigma_m)
    assert judged([sure] * 20 + [worse] * 20)
    assert not judged([sure] * 40)
    assert not judged([worse] * 40)
    best = Sight(PLENTY, None, 0.1 * OPTIONS.sigma_m)
    good = Sight(PLENTY, None, 0.99 * OPTIONS.sigma_m)
    assert not judged([best] * 20 + [good] * 20)


def test_a_view_from_a_new_place_is_a_reason() -> None:
    known = Sight(PLENTY, novelty_deg=0.9 * OPTIONS.novelty_deg)
    new = Sight(PLENTY, novelty_deg=1.1 * OPTIONS.novelty_deg)
    assert not judged([known] * 40)
    assert judged([known] * 20 + [new] * 20)
    assert not judged([new] * 20 + [known] * 20)


@pytest.mark.parametrize(
    "newest", [Sight(FEW), Sight(PLENTY, novelty_deg=1.1 * OPTIONS.novelty_deg)]
)
def test_a_vote_is_open_from_the_first_look_that_may_lead_to_one_until_it_has(
    newest: Sight,
) -> None:
    vote = OwnVote(OPTIONS)
    for k in range(20):
        vote.look(FIRST, Sight(PLENTY), k * STEP_S)
        assert not vote.is_open(k * STEP_S)
    votes, is_open = [], []
    for k in range(20, 40):
        votes.append(vote.look(FIRST, newest, k * STEP_S))
        is_open.append(vote.is_open(k * STEP_S))
    assert is_open[0]
    assert not votes[0]
    assert votes[-1]
    # Never both, and nothing between.
    assert [a != b for a, b in zip(votes, is_open, strict=True)] == [True] * 20


def test_no_vote_is_open_where_there_is_no_map_or_maps_stay_as_they_are() -> None:
    stays = OwnVote(replace(OPTIONS, tracked=0, share=0.0))
    for k in range(40):
        assert not stays.look(FIRST, Sight(PLENTY, novelty_deg=90.0 + k), k * STEP_S)
        assert not stays.is_open(k * STEP_S)
    without = OwnVote(OPTIONS)
    without.look(b"", Sight(FEW), 0.0)
    assert not without.is_open(0.0)


def test_a_map_that_no_frame_was_looked_at_on_is_not_voted_on() -> None:
    vote = OwnVote(OPTIONS)
    for k in range(20):
        vote.look(FIRST, Sight(FEW), k * STEP_S)
    assert vote.look(FIRST, Sight(FEW), 2.0) is True
    assert vote.unseen() is False
    assert vote.look(b"next", Sight(PLENTY), 2.1) is False


def test_the_reasons_for_a_vote_are_bounded() -> None:
    with pytest.raises(ValueError, match="novelty_deg"):
        UpdateOptions(novelty_deg=0.0)
    for covered in (-0.1, 1.0):
        with pytest.raises(ValueError, match="covered"):
            UpdateOptions(covered=covered)
    with pytest.raises(ValueError, match="sigma_m"):
        UpdateOptions(sigma_m=0.0)
    with pytest.raises(ValueError, match="sigma_growth"):
        UpdateOptions(sigma_growth=1.0)
