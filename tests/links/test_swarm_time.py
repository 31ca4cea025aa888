"""The swarm's time: it never falls, and who is behind learns it from who has the key, now."""

from hypothesis import given
from hypothesis import strategies as st

from tests.links.signed import NOON, NOON_S, Clocks
from vcl_companion.links.swarm_time import EARLIEST, END, LATEST, SwarmTime

S = 100_000  # ticks
DAY = 86400 * S
YEAR = 31_557_600 * S


def test_it_is_the_wall_clock_where_that_is_right() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.at(clocks.now()) == NOON
    assert time.at(clocks.pass_s(1.5)) == NOON + 150_000


def test_a_clock_that_starts_in_1970_goes_on_above_what_was_reserved() -> None:
    clocks = Clocks(wall_s=12.0)
    time = SwarmTime(NOON, clocks.now())
    assert time.next(clocks.now()) == NOON + 1
    assert time.next(clocks.pass_s(2.0)) == NOON + 2 * S
    clocks.wall_s = NOON_S + 3600.0  # a time server is found
    assert time.next(clocks.now()) == NOON + 3600 * S


def test_a_drone_without_any_memory_starts_where_nothing_was_signed_before() -> None:
    clocks = Clocks(wall_s=0.0)
    assert SwarmTime(0, clocks.now()).at(clocks.now()) == EARLIEST


def test_a_wall_clock_that_is_set_back_changes_nothing() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.next(clocks.now()) == NOON
    clocks.wall_s -= 86400.0
    assert time.next(clocks.now()) == NOON + 1
    assert time.next(clocks.pass_s(5.0)) == NOON + 5 * S


def test_a_clock_of_an_absurd_year_is_not_believed() -> None:
    clocks = Clocks(wall_s=5e9)
    assert SwarmTime(NOON, clocks.now()).at(clocks.now()) == NOON
    assert SwarmTime(2**48 - 1, clocks.now()).at(clocks.now()) == END


def test_who_is_behind_is_told_by_an_answer_to_its_own_question() -> None:
    clocks = Clocks(wall_s=0.0)
    time = SwarmTime(NOON, clocks.now())
    assert time.told(7, NOON + DAY, clocks.now()) is None  # nobody asked
    assert time.asks(7, clocks.now())
    assert time.told(8, NOON + DAY, clocks.now()) is None  # an answer to another question
    assert time.told(7, NOON + DAY, clocks.pass_s(0.5)) == 86399.5
    assert time.at(clocks.pass_s(1.0)) == NOON + DAY + S
    # A member that is further ahead may answer the same question, one behind changes nothing.
    assert time.told(7, NOON, clocks.now()) is None
    assert time.told(7, NOON + 2 * DAY, clocks.now()) == 86399.0


def test_a_late_answer_is_no_answer() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.asks(7, clocks.now())
    assert not time.asks(8, clocks.pass_s(2.9))
    assert time.told(7, NOON + DAY, clocks.pass_s(0.1)) is None
    assert time.asks(9, clocks.now())
    assert time.told(7, NOON + DAY, clocks.now()) is None
    assert time.told(9, NOON + DAY, clocks.now()) is not None


def test_nobody_is_followed_into_the_far_future() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.asks(7, clocks.now())
    for timestamp in (2**48 - 1, LATEST + 1):
        assert time.told(7, timestamp, clocks.now()) is None
    assert time.at(clocks.now()) == NOON
    assert time.told(7, LATEST, clocks.now()) is not None


def test_what_one_is_told_the_others_can_be_told_whatever_their_clocks_say() -> None:
    """Or a wrong clock would part those who follow it from those who do not."""
    clocks = [Clocks(), Clocks(wall_s=NOON_S - 30.0), Clocks(wall_s=0.0)]
    times = [SwarmTime(0, c.now()) for c in clocks]
    for said in (NOON + 10 * YEAR - S, NOON + 30 * YEAR, LATEST):
        for c, time in zip(clocks, times, strict=True):
            assert time.asks(said, c.pass_s(10.0))
            assert time.told(said, said, c.now()) is not None
            assert time.at(c.now()) == said


def test_who_was_told_the_latest_time_goes_on_from_there_after_a_restart() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.asks(7, clocks.now())
    assert time.told(7, LATEST, clocks.now()) is not None
    mark = time.next(clocks.pass_s(3600.0))
    assert mark > LATEST
    assert SwarmTime(mark, clocks.now()).at(clocks.now()) == mark


def test_a_member_is_not_answered_more_often_than_it_needs() -> None:
    clocks = Clocks()
    time = SwarmTime(0, clocks.now())
    assert time.answers(2, clocks.now())
    assert not time.answers(2, clocks.pass_s(0.1))
    assert time.answers(3, clocks.now())
    assert time.answers(2, clocks.pass_s(0.11))


STEPS = st.tuples(
    st.floats(-1e10, 1e10),  # the wall clock is set
    st.floats(0.0, 1e5),  # time passes
    st.integers(0, 2**48 - 1),  # somebody says a time
    st.booleans(),
)


@given(st.integers(0, 2**48 - 1), st.floats(-1e9, 1e10), st.lists(STEPS, max_size=30))
def test_it_rises_whatever_happens(
    reserved: int, wall_s: float, steps: list[tuple[float, float, int, bool]]
) -> None:
    clocks = Clocks(wall_s=wall_s)
    time = SwarmTime(reserved, clocks.now())
    before, signed = time.at(clocks.now()), time.next(clocks.now())
    assert before >= min(reserved, END)
    for k, (set_s, pass_s, said, asked) in enumerate(steps):
        clocks.wall_s += set_s
        now = clocks.pass_s(pass_s)
        if asked:
            time.asks(k, now)
        time.told(k, said, now)
        assert time.at(now) >= before
        assert time.next(now) > signed
        before, signed = time.at(now), signed + 1
        signed = max(signed, before)
        assert signed < 2**48
