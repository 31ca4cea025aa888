"""Blobs over a bad network: whole, or a stated failure; frugal; resumable; deterministic."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.swarm.network import CALM, DEFAULTS, Network, Weather
from vcl_companion.errors import ConfigError
from vcl_companion.swarm.budget import FRAME_OVERHEAD_BYTES
from vcl_companion.swarm.transfer import (
    BlobDelivered,
    BlobKind,
    BlobReceived,
    TransferFailed,
    TransferOptions,
    Transfers,
)
from vcl_companion.wire.header import MAX_BLOB_BYTES

MAP = BlobKind.MAP
BLOB = np.random.default_rng(0).bytes(50_000)


def two_drones(
    weather: Weather = CALM, options: TransferOptions = DEFAULTS, seed: int = 0
) -> Network:
    network = Network(weather, options, seed)
    network.add(1)
    network.add(2)
    return network


def send(network: Network, blob: bytes, kind: BlobKind = MAP, until_s: float = 400.0) -> None:
    """Send a blob from 1 to 2 and run until it is over."""
    network.drones[1].submit(2, kind, blob, network.now_s)
    network.run(until_s, stop=lambda: bool(network.ends()))


@pytest.mark.parametrize("n_bytes", [0, 1, 82, 83, 201, 202, 50_000])
def test_a_good_network_takes_each_chunk_once(n_bytes: int) -> None:
    network = two_drones()
    send(network, BLOB[:n_bytes])
    assert network.blobs(2) == [BLOB[:n_bytes]]
    assert network.ends() == [BlobDelivered(2, 1)]
    n_chunks = -(-(n_bytes + 37) // 119)
    statuses_bytes = network.n_bytes - (n_bytes + 37 + 9 * n_chunks)
    if n_bytes < 1000:
        assert (network.n_payloads, statuses_bytes) == (n_chunks + 1, 16)
    else:  # it lasts longer than a status interval, so there is one answer on the way
        assert network.n_payloads == n_chunks + 2
        assert 16 < statuses_bytes < 50


def test_the_rate_is_kept() -> None:
    options = TransferOptions(rate_bytes_per_s=10_000.0, burst_bytes=1000)
    network = two_drones(options=options)
    start_s = network.now_s
    send(network, BLOB)
    lasted_s = network.now_s - start_s
    on_the_link = network.n_bytes + FRAME_OVERHEAD_BYTES * network.n_payloads
    assert 0.99 < (on_the_link - 1000) / 10_000.0 / lasted_s < 1.01


@pytest.mark.parametrize("seed", range(5))
def test_twenty_percent_loss_takes_at_most_1_4_times_the_bytes(seed: int) -> None:
    """Counted against the blob itself, so headers, repeats and statuses all count."""
    network = two_drones(Weather(loss=0.2), seed=seed)
    send(network, BLOB)
    assert network.blobs(2) == [BLOB]
    assert 1.2 < network.n_bytes / len(BLOB) < 1.4


def test_delay_beyond_the_status_interval_costs_few_repeats() -> None:
    network = two_drones(Weather(loss=0.2, delay_s=0.4, jitter_s=0.05))
    send(network, BLOB)
    assert network.blobs(2) == [BLOB]
    assert network.n_bytes / len(BLOB) < 1.45


@pytest.mark.parametrize("loss", [0.5, 0.65])
def test_heavy_loss_still_finishes(loss: float) -> None:
    network = two_drones(Weather(loss=loss), seed=3)
    send(network, BLOB[:20_000])
    assert network.blobs(2) == [BLOB[:20_000]]
    assert network.n_bytes / 20_000 < 1.6 / (1 - loss)


@given(
    weather=st.builds(
        Weather,
        loss=st.floats(0.0, 0.95),
        duplicates=st.floats(0.0, 1.0),
        corrupt=st.floats(0.0, 0.02),
        delay_s=st.floats(0.0, 0.5),
        jitter_s=st.floats(0.0, 1.0),
    ),
    n_bytes=st.integers(0, 4000),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60)
def test_in_any_weather_the_blob_arrives_whole_or_a_failure_is_stated(
    weather: Weather, n_bytes: int, seed: int
) -> None:
    network = two_drones(weather, TransferOptions(give_up_s=20.0), seed)
    send(network, BLOB[:n_bytes], until_s=10_000.0)
    (end,) = network.ends()
    match end:
        case BlobDelivered():
            assert network.blobs(2) == [BLOB[:n_bytes]]
        case TransferFailed(reason=reason):
            assert "peer 2" in reason
            assert network.blobs(2) in ([], [BLOB[:n_bytes]])
    network.run(20_000.0)  # late chunks: nothing is handed out twice, nothing stays
    assert len(network.blobs(2)) <= 1
    assert network.drones[2].incoming_memory_bytes == 0


def test_a_silent_peer_is_a_stated_failure_in_the_stated_time() -> None:
    network = two_drones(Weather(loss=1.0))
    start_s = network.now_s
    send(network, BLOB)
    assert network.ends() == [TransferFailed(2, 1, "no answer from peer 2 for 30 s")]
    assert network.now_s - start_s == pytest.approx(30.0)
    assert network.n_bytes < 1.25 * len(BLOB)


def test_a_receiver_that_restarts_midway_still_gets_it() -> None:
    network = two_drones(Weather(loss=0.1))
    network.drones[1].submit(2, MAP, BLOB, network.now_s)
    network.run(400.0, stop=lambda: network.n_bytes > 30_000)
    assert network.drones[2].incoming_memory_bytes > 20_000
    network.add(2)
    network.run(400.0, stop=lambda: bool(network.ends()))
    assert network.ends() == [BlobDelivered(2, 1)]
    assert network.blobs(2) == [BLOB]
    assert network.n_bytes < 2.0 * len(BLOB)


def test_a_receiver_that_restarts_when_it_lacks_the_last_chunk_begins_again() -> None:
    # Drawn so that all but the last chunk arrive, and that is known, before it does.
    network = two_drones(Weather(loss=0.3), seed=17)
    network.drones[1].submit(2, MAP, BLOB, network.now_s)
    (sending,) = network.drones[1]._sendings
    arrived = sending._receivers[2].arrived
    network.run(400.0, stop=lambda: bool(arrived[:-1].all()))
    assert not arrived[-1]
    network.add(2)
    restarted_s = network.now_s
    network.run(400.0, stop=lambda: bool(network.ends()))
    assert network.ends() == [BlobDelivered(2, 1)]
    assert network.blobs(2) == [BLOB]
    assert network.now_s - restarted_s < 10.0


def test_a_sender_that_restarts_midway_sends_little_twice() -> None:
    network = two_drones(options=TransferOptions(rate_bytes_per_s=50_000.0))
    network.drones[1].submit(2, MAP, BLOB, network.now_s)
    network.run(400.0, stop=lambda: network.n_bytes > 30_000)
    network.add(1)
    network.run(200.0)
    before = network.n_bytes
    send(network, BLOB)
    assert network.blobs(2) == [BLOB]
    # It is told what is there already at its first ask, a round trip after the start.
    assert network.n_bytes - before < 0.7 * len(BLOB)


def test_a_gap_of_the_link_within_patience_is_bridged() -> None:
    network = two_drones()
    network.is_up = lambda now_s: not 100.1 < now_s < 120.0
    send(network, BLOB)
    assert network.ends() == [BlobDelivered(2, 1)]
    assert network.now_s > 120.0
    assert network.n_bytes < 1.9 * len(BLOB)


def test_a_gap_beyond_patience_fails_and_the_next_try_completes_the_parts() -> None:
    options = TransferOptions(rate_bytes_per_s=20_000.0)
    network = two_drones(options=options)
    network.is_up = lambda now_s: not 101.5 < now_s < 160.0
    send(network, BLOB)
    assert [type(end) for end in network.ends()] == [TransferFailed]
    network.run(170.0)
    before = network.n_bytes
    network.log.clear()
    send(network, BLOB)
    assert network.blobs(2) == [BLOB]
    assert network.n_bytes - before < 0.7 * len(BLOB)


def test_damage_the_link_did_not_notice_costs_repeats_not_the_blob() -> None:
    network = two_drones(Weather(corrupt=0.004), seed=2)
    send(network, BLOB[:10_000])
    assert network.blobs(2) == [BLOB[:10_000]]


def test_damage_every_time_is_refused_with_a_reason() -> None:
    network = two_drones(Weather(corrupt=0.5), seed=1)
    send(network, BLOB[:10_000])
    (end,) = network.ends()
    assert isinstance(end, TransferFailed)
    assert "damaged" in end.reason
    assert network.blobs(2) == []


def test_many_drones_exchange_many_blobs() -> None:
    options = TransferOptions(rate_bytes_per_s=100_000.0)
    network = Network(Weather(loss=0.1, duplicates=0.1, jitter_s=0.02), options, seed=5)
    drones = range(1, 7)
    for drone in drones:
        network.add(drone)
    expected: dict[int, set[bytes]] = {drone: set() for drone in drones}
    for sender in drones:
        for receiver in drones:
            for k in range(6):  # more at once than one peer takes at once
                blob = BLOB[: 100 * sender + 10 * receiver + k + 500]
                if sender != receiver:
                    network.drones[sender].submit(receiver, MAP, blob, network.now_s)
                    expected[receiver].add(blob)
    network.run(300.0, stop=lambda: len(network.ends()) == 6 * 5 * 6)
    assert all(isinstance(end, BlobDelivered) for end in network.ends())
    assert {drone: set(network.blobs(drone)) for drone in drones} == expected


def test_transfers_share_the_budget_fairly() -> None:
    network = two_drones(options=TransferOptions(rate_bytes_per_s=20_000.0))
    network.add(3)
    for peer in (2, 3):
        network.drones[1].submit(peer, MAP, BLOB, network.now_s)
    network.run(400.0, stop=lambda: len(network.ends()) == 2)
    times = [at_s for at_s, _, event in network.log if isinstance(event, BlobReceived)]
    assert abs(times[0] - times[1]) < 0.3


def test_the_same_blob_on_its_way_is_the_same_transfer() -> None:
    network = two_drones()
    first = network.drones[1].submit(2, MAP, BLOB, network.now_s)
    assert network.drones[1].submit(2, MAP, BLOB, network.now_s) == first
    assert network.drones[1].submit(2, BlobKind.FRAME_ANSWER, BLOB, network.now_s) != first
    network.run(400.0, stop=lambda: len(network.ends()) == 2)
    assert [e.kind for e in network.events(2, BlobReceived) if isinstance(e, BlobReceived)] == [
        BlobKind.FRAME_ANSWER,  # the more urgent
        MAP,
    ]


def test_a_blob_the_peer_has_is_delivered_for_next_to_nothing_and_not_handed_out_again() -> None:
    network = two_drones(options=TransferOptions(rate_bytes_per_s=20_000.0, burst_bytes=158))
    send(network, BLOB[:200])
    before = network.n_bytes
    network.log.clear()
    send(network, BLOB[:200])
    assert network.ends() == [BlobDelivered(2, 2)]
    assert network.blobs(2) == []
    assert network.n_bytes - before < 400
    network.run(network.now_s + 130.0)  # longer than it remembers
    network.log.clear()
    send(network, BLOB[:200], until_s=600.0)
    assert network.blobs(2) == [BLOB[:200]]


def test_a_cancelled_transfer_sends_no_more_and_says_nothing() -> None:
    network = two_drones(options=TransferOptions(rate_bytes_per_s=20_000.0))
    transfer_id = network.drones[1].submit(2, MAP, BLOB, network.now_s)
    network.run(100.5)
    network.drones[1].cancel(transfer_id)
    sent = network.n_bytes
    network.run(200.0)
    assert network.n_bytes - sent < 500  # the receiver's last answer at most
    assert network.ends() == []


def test_what_was_of_no_use_can_be_sent_again_but_not_at_once() -> None:
    network = two_drones()
    send(network, BLOB)
    network.drones[2].forget(1, MAP, BLOB, network.now_s + 5.0)
    send(network, BLOB)  # too early: it is told that the blob is there
    assert network.blobs(2) == [BLOB]
    network.now_s += 5.0
    network.log.clear()
    send(network, BLOB)
    assert network.blobs(2) == [BLOB]
    assert len(network.ends()) == 1
    network.drones[2].forget(1, MAP, BLOB[1:], 0.0)  # one that never came


def test_what_is_coming_in_is_known_by_its_kind() -> None:
    network = two_drones(options=TransferOptions(rate_bytes_per_s=1000.0, burst_bytes=158))
    two = network.drones[2]
    network.drones[1].submit(2, MAP, BLOB, network.now_s)
    assert not two.is_receiving(MAP, network.now_s)
    network.run(network.now_s + 5.0)
    assert two.is_receiving(MAP, network.now_s)
    assert not two.is_receiving(BlobKind.FRAME_ANSWER, network.now_s)
    assert not two.is_receiving(MAP, network.now_s + network.options.pace.give_up_s)
    network.run(network.now_s + 100.0, stop=lambda: bool(network.ends()))
    assert not two.is_receiving(MAP, network.now_s)


def test_it_is_deterministic() -> None:
    weather = Weather(loss=0.3, duplicates=0.1, corrupt=0.001, jitter_s=0.05)
    runs = []
    for _ in range(2):
        network = two_drones(weather, seed=11)
        send(network, BLOB)
        runs.append((network.n_bytes, network.now_s, network.log))
    assert runs[0] == runs[1]


def test_nothing_to_do_is_never() -> None:
    transfers = Transfers(TransferOptions(), np.random.default_rng(0))
    assert transfers.next_poll_s() is None
    assert transfers.poll(5.0) == ([], [])
    with pytest.raises(ValueError, match="at most"):
        transfers.submit(2, MAP, bytes(MAX_BLOB_BYTES + 1), 0.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rate_bytes_per_s", 0.0),
        ("rate_bytes_per_s", float("nan")),
        ("burst_bytes", 157),
        ("status_interval_s", 20.0),
        ("max_blob_bytes", MAX_BLOB_BYTES + 1),
        ("max_incoming_per_peer", 0),
        ("memory_quota_bytes", MAX_BLOB_BYTES),
    ],
)
def test_options_out_of_bounds_are_a_config_error(name: str, value: Any) -> None:
    with pytest.raises(ConfigError, match=name):
        replace(DEFAULTS, **{name: value})
