"""The model of a bad radio: every impairment by its statistics, and what none may ever do."""

from __future__ import annotations

import math
from itertools import groupby, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.network import Delivery, Network, NetworkOptions
from sitl.partitions import Partition, check_partitions, parse_partition
from vcl_companion.errors import ConfigError

N = 20_000
PERIOD_S = 0.01
# A bound of so many sigmas: the seed is fixed, so it holds for ever once it does; it is wide
# so that another version of numpy, with other draws, does not make it fail by chance.
SIGMAS = 5.0

SHARES = st.floats(0.0, 1.0)
IMPAIRMENTS = st.builds(
    NetworkOptions,
    loss=SHARES,
    delay_s=st.floats(0.0, 2.0),
    jitter_s=st.floats(0.0, 1.0),
    reorder=SHARES,
    duplicate=SHARES,
    corrupt=SHARES,
    rate_bits_per_s=st.none() | st.floats(1e3, 1e7),
    shared=st.just(False),
    queue_s=st.floats(0.0, 1.0),
)
# Gaps between datagrams, and their lengths.
SENDINGS = st.lists(st.tuples(st.floats(0.0, 0.1), st.binary(max_size=60)), max_size=40)


def numbered(k: int) -> bytes:
    return k.to_bytes(4, "big")


def fates(options: NetworkOptions, seed: int = 1, n: int = N) -> list[list[Delivery]]:
    """Return what becomes of n datagrams that say which they are, 10 ms apart."""
    network = Network(options, seed)
    return [network.send(k * PERIOD_S, "mav0", "mav1", numbered(k)) for k in range(n)]


def assert_share(count: int, share: float, n: int = N, correlation: float = 1.0) -> None:
    sigma = math.sqrt(share * (1.0 - share) / n * correlation)
    assert abs(count / n - share) < SIGMAS * sigma


def test_a_perfect_network_delivers_everything_at_once() -> None:
    for k, arrived in enumerate(fates(NetworkOptions(), n=100)):
        assert arrived == [Delivery(k * PERIOD_S, numbered(k))]


@pytest.mark.parametrize("loss", [0.05, 0.2, 0.6])
def test_loss_is_the_share_asked_for_and_has_no_memory(loss: float) -> None:
    lost = [not arrived for arrived in fates(NetworkOptions(loss=loss))]
    assert_share(sum(lost), loss)
    after_loss = [later for earlier, later in pairwise(lost) if earlier]
    assert_share(sum(after_loss), loss, len(after_loss))


@pytest.mark.parametrize(("loss", "burst"), [(0.2, 8.0), (0.5, 3.0), (0.05, 20.0)])
def test_burst_loss_has_the_same_share_in_runs_of_the_mean_asked_for(
    loss: float, burst: float
) -> None:
    n = 10 * N
    lost = [not arrived for arrived in fates(NetworkOptions(loss=loss, burst=burst), n=n)]
    # A chain of two states: neighbours are correlated by what is left of both ways out.
    stays = 1.0 - 1.0 / burst - loss / (1.0 - loss) / burst
    assert_share(sum(lost), loss, n, (1.0 + stays) / (1.0 - stays))
    runs = [len(list(run)) for is_lost, run in groupby(lost) if is_lost]
    # Lengths are geometric: sigma is sqrt(burst * (burst - 1)).
    sigma = math.sqrt(burst * (burst - 1.0) / len(runs))
    assert abs(sum(runs) / len(runs) - burst) < SIGMAS * sigma


def test_delay_and_jitter_are_between_their_bounds_and_spread_evenly() -> None:
    options = NetworkOptions(delay_s=0.15, jitter_s=0.05)
    late = [one.due_s - k * PERIOD_S - 0.15 for k, (one,) in enumerate(fates(options))]
    assert min(late) >= -1e-9
    assert max(late) <= 0.05 + 1e-9
    mean = sum(late) / N
    assert abs(mean - 0.025) < SIGMAS * 0.05 / math.sqrt(12 * N)
    assert_share(sum(one < 0.0125 for one in late), 0.25)


def test_reordering_lets_those_that_follow_overtake() -> None:
    arrived = [one for (one,) in fates(NetworkOptions(delay_s=0.1, reorder=0.1))]
    held = [one.due_s - k * PERIOD_S > 0.1 + 1e-9 for k, one in enumerate(arrived)]
    assert_share(sum(held), 0.1)
    order = [one.data for one in sorted(arrived, key=lambda one: one.due_s)]
    # Not overtaken: the next five, 10 ms apart, were all held back as well.
    moved = sum(data != numbered(k) for k, data in enumerate(order))
    assert moved > sum(held)


def test_duplicates_arrive_twice_the_same() -> None:
    both = [arrived for arrived in fates(NetworkOptions(duplicate=0.3)) if len(arrived) == 2]
    assert_share(len(both), 0.3)
    assert all(first == second for first, second in both)


def test_corruption_changes_up_to_eight_bytes_and_never_none() -> None:
    network, whole = Network(NetworkOptions(corrupt=0.25), 3), bytes(range(60))
    damaged = []
    for k in range(N):
        (one,) = network.send(float(k), "mav0", "mav1", whole)
        assert len(one.data) == len(whole)
        changed = [n for n, (a, b) in enumerate(zip(one.data, whole, strict=True)) if a != b]
        if changed:
            damaged.append(changed)
    assert_share(len(damaged), 0.25)
    assert all(run == list(range(run[0], run[-1] + 1)) for run in damaged)
    assert {len(run) for run in damaged} == set(range(1, 9))
    assert {n for run in damaged for n in run} == set(range(60))
    assert network.fates["mav0", "mav1"].corrupted == len(damaged)


@given(st.floats(1e3, 1e6), st.floats(0.0, 0.5), SENDINGS)
def test_a_rate_is_never_exceeded_in_any_time(
    rate: float, queue_s: float, sendings: list[tuple[float, bytes]]
) -> None:
    """In any time as many bits arrive as fit it, and the datagram that was under way."""
    network = Network(NetworkOptions(rate_bits_per_s=rate, queue_s=queue_s), 1)
    now_s, ends = 0.0, []
    for gap_s, data in sendings:
        now_s += gap_s
        for due_s, arrived in network.send(now_s, "mav0", "mav1", data):
            airtime_s = 8 * len(arrived) / rate
            assert now_s + airtime_s - 1e-9 <= due_s <= now_s + queue_s + airtime_s + 1e-9
            ends.append((due_s, 8 * len(arrived)))
    for first in range(len(ends)):
        bits = 0
        for due_s, n_bits in ends[first + 1 :]:
            bits += n_bits
            assert bits <= rate * (due_s - ends[first][0]) + 1e-6 * rate


def test_a_full_queue_drops_what_comes_last_and_is_used_up() -> None:
    """1000 bytes a second, half a second of queue: ten of 100 bytes at once, six go."""
    network = Network(NetworkOptions(rate_bits_per_s=8000.0), 1)
    arrived = [network.send(5.0, "mav0", "mav1", bytes([k]) * 100) for k in range(10)]
    dues = [one.due_s for some in arrived for one in some]
    assert dues == pytest.approx([5.1, 5.2, 5.3, 5.4, 5.5, 5.6])
    assert [bool(some) for some in arrived] == [True] * 6 + [False] * 4
    assert network.fates["mav0", "mav1"].queue_full == 4
    (later,) = network.send(5.7, "mav0", "mav1", bytes(100))
    assert later.due_s == pytest.approx(5.8)


def test_a_sender_s_rate_is_for_all_its_receivers_and_a_shared_one_for_all_senders() -> None:
    def due_s(shared: bool, sender: str, receiver: str) -> float:
        network = Network(NetworkOptions(rate_bits_per_s=8000.0, shared=shared), 1)
        network.send(0.0, "mav0", "mav1", bytes(100))
        ((due, _),) = network.send(0.0, sender, receiver, bytes(100))
        return due

    assert due_s(False, "mav0", "mav2") == pytest.approx(0.2)
    assert due_s(False, "mav2", "mav0") == pytest.approx(0.1)
    assert due_s(True, "mav2", "mav0") == pytest.approx(0.2)


def test_a_broadcast_takes_the_transmitter_once_and_each_air_for_itself() -> None:
    network = Network(NetworkOptions(rate_bits_per_s=8000.0, loss=0.5), 1)
    receivers = [f"mav{n}" for n in range(1, 200)]
    arrived = network.broadcast(0.0, "mav0", receivers, bytes(100))
    assert {delivery.due_s for _, delivery in arrived} == {0.1}
    assert_share(len(arrived), 0.5, len(receivers))


def test_a_partition_cuts_between_its_groups_for_its_time_only() -> None:
    partition = parse_partition("10-40:mav0|mav1,mav2")
    network = Network(NetworkOptions(partitions=(partition,)), 1)

    def hears(at_s: float, sender: str, receiver: str) -> bool:
        return bool(network.send(100.0, sender, receiver, b"x", flight_s=at_s))

    for sender, receiver in (("mav0", "mav1"), ("mav2", "mav0")):
        heard = [hears(at_s, sender, receiver) for at_s in (9.99, 10.0, 39.99, 40.0)]
        assert heard == [True, False, False, True]
    assert hears(20.0, "mav1", "mav2")
    assert hears(20.0, "mav0", "mav3")  # in no group: hears everybody
    assert network.fates["mav0", "mav1"].cut == 2


def test_a_link_s_fate_hangs_on_the_seed_and_on_no_other_link() -> None:
    options = NetworkOptions(
        loss=0.3, burst=4.0, delay_s=0.1, jitter_s=0.1, duplicate=0.2, corrupt=0.2
    )
    alone = fates(options, n=500)
    assert fates(options, n=500) == alone
    assert fates(options, seed=2, n=500) != alone
    crowd = Network(options, 1)
    among = []
    for k in range(500):
        for other in range(20):
            crowd.send(k * PERIOD_S, f"mav{other}", "mav0", b"noise")
        among.append(crowd.send(k * PERIOD_S, "mav0", "mav1", numbered(k)))
        crowd.send(k * PERIOD_S, "mav1", "mav0", b"answer")
    assert among == alone
    back = [crowd.send(9.0, "mav1", "mav0", numbered(k)) for k in range(500)]
    assert [bool(one) for one in back] != [bool(one) for one in alone]


def test_one_impairment_more_leaves_what_is_lost_as_it_was() -> None:
    plain = fates(NetworkOptions(loss=0.3), n=500)
    more = fates(NetworkOptions(loss=0.3, jitter_s=0.1, duplicate=0.5, corrupt=0.5), n=500)
    assert [bool(one) for one in plain] == [bool(one) for one in more]


@given(IMPAIRMENTS, SENDINGS, st.integers(0, 9))
def test_nothing_arrives_that_was_not_sent_nor_before(
    options: NetworkOptions, sendings: list[tuple[float, bytes]], seed: int
) -> None:
    network, now_s, n_arrived = Network(options, seed), 0.0, 0
    for gap_s, data in sendings:
        now_s += gap_s
        arrived = network.send(now_s, "mav0", "mav1", data)
        n_arrived += len(arrived)
        assert len(arrived) <= 2
        for one in arrived:
            assert len(one.data) == len(data)
            assert one.due_s >= now_s + options.delay_s
            if options.corrupt == 0.0:
                assert one.data == data
    fate = network.fates.get(("mav0", "mav1"))
    if fate is not None:
        assert fate.delivered == n_arrived
        assert fate.offered == len(sendings)
        gone = fate.cut + fate.queue_full + fate.lost
        assert fate.offered == gone + fate.delivered - fate.duplicated


@given(SENDINGS, st.floats(0.0, 0.9), st.floats(0.0, 1.0), st.none() | st.floats(1e3, 1e6), SHARES)
def test_order_is_kept_without_jitter_and_reordering(
    sendings: list[tuple[float, bytes]],
    loss: float,
    delay_s: float,
    rate: float | None,
    duplicate: float,
) -> None:
    options = NetworkOptions(loss=loss, delay_s=delay_s, rate_bits_per_s=rate, duplicate=duplicate)
    network, now_s, dues = Network(options, 1), 0.0, []
    for gap_s, data in sendings:
        now_s += gap_s
        dues += [one.due_s for one in network.send(now_s, "mav0", "mav1", data)]
    assert dues == sorted(dues)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"loss": 1.2}, "--loss must be a share of 0 to 1, got 1.2"),
        ({"reorder": -0.1}, "--reorder must be a share"),
        ({"duplicate": math.nan}, "--duplicate must be a share"),
        ({"corrupt": math.inf}, "--corrupt must be a share"),
        ({"delay_s": -1.0}, "--delay must be 0 to 60 s"),
        ({"jitter_s": math.inf}, "--jitter must be 0 to 60 s"),
        ({"queue_s": math.nan}, "--queue must be 0 to 60 s"),
        ({"burst": 4.0}, "--burst needs a --loss"),
        ({"burst": 4.0, "loss": 1.0}, "--burst needs a --loss"),
        ({"burst": 0.5, "loss": 0.2}, "--burst must be a mean of 1 datagrams or more"),
        ({"burst": 2.0, "loss": 0.8}, "--burst must be a mean of 4 datagrams or more"),
        ({"rate_bits_per_s": 0.0}, "--rate must be positive"),
        ({"rate_bits_per_s": math.inf}, "--rate must be positive"),
        ({"shared": True}, "--shared says who has the --rate"),
    ],
)
def test_options_have_bounds(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError) as raised:
        NetworkOptions(**options)  # type: ignore[arg-type]  # the point of the test
    assert message in str(raised.value)


def test_a_partition_on_the_command_line() -> None:
    partition = parse_partition("10-40.5: mav0 | mav1, mav2")
    assert partition == Partition(10.0, 40.5, (frozenset({"mav0"}), frozenset({"mav1", "mav2"})))
    assert parse_partition(str(partition)) == partition
    for text in (
        "", "10-40", "10-40:", "10-40:mav0", "40-10:mav0|mav1", "10-10:mav0|mav1", "a-b:mav0|mav1",
        "10-40:mav0|mav0", "10-40:mav0||mav1", "10-40:mav0,mav0|mav1", "1.2.3-40:mav0|mav1",
        "-10-40:mav0|mav1", f"0-{'9' * 400}:mav0|mav1",
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=r"--partition .* like 10-40:mav0\|mav1,mav2") as said:
            parse_partition(text)
        assert "\n" not in str(said.value)
    check_partitions([partition], ["mav0", "mav1", "mav2"], 10.5)
    with pytest.raises(ConfigError, match=r"10-40.5:.* the flight is over after 10.0 s"):
        check_partitions([partition], ["mav0", "mav1", "mav2"], 10.0)
    with pytest.raises(ConfigError, match=r"'mav2' does not fly \(mav0, mav1\)"):
        check_partitions([partition], ["mav0", "mav1"], 60.0)
