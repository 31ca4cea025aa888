"""A pose is flown on, a map is waited for: what goes first, and that all of it goes."""

from __future__ import annotations

import numpy as np
import pytest

from tests.swarm.network import DEFAULTS, Network, Weather
from vcl_companion.geometry.pose import Pose
from vcl_companion.swarm.transfer import BlobKind, BlobReceived, TransferOptions, Transfers
from vcl_companion.swarm.transfer_options import PROFILES, Profile
from vcl_companion.swarm.urgency import Turns, Urgency
from vcl_companion.wire.chunks import Chunk
from vcl_companion.wire.messages import FrameRequest, MapState
from vcl_companion.wire.pose_messages import PoseProposal
from vcl_companion.wire.tunnel import decode_payload

BLOB = np.random.default_rng(0).bytes(40_000)
NO_MAP = MapState(b"", 0, False, 0, False)


def proposal(request_id: int) -> PoseProposal:
    return PoseProposal.of(request_id, bytes(8), Pose.identity(), 1e-2 * np.eye(6))


def radio_57k(loss: float = 0.0) -> Network:
    """Two drones, each at a radio of 57,600 baud, ten bits a byte."""
    options = TransferOptions(profile="radio-57k")
    network = Network(Weather(loss, delay_s=0.03, radio_bytes_per_s=5760.0), options)
    network.add(1)
    network.add(2)
    return network


@pytest.mark.parametrize("kinds", [[BlobKind.MAP], list(BlobKind)], ids=["a map", "all kinds"])
def test_at_57600_baud_a_proposal_waits_half_a_second_at_most(kinds: list[BlobKind]) -> None:
    network = radio_57k()
    one = network.drones[1]
    for kind in kinds:
        one.submit(2, kind, BLOB, network.now_s)
    waited_s = []
    for request_id in range(30):
        network.run(network.now_s + 0.21 + 0.01 * request_id)
        posted_at_s = network.now_s
        one.post(2, proposal(request_id))
        network.run(network.now_s + 2.0, stop=lambda: bool(network.heard))
        (at_s, drone, message) = network.heard.pop()
        assert (drone, message) == (2, proposal(request_id))
        waited_s.append(at_s - posted_at_s)
    assert network.n_bytes > 30_000  # the transfers went on meanwhile
    assert 0.05 < max(waited_s) < 0.5


def test_blobs_arrive_by_urgency_not_by_submission() -> None:
    network = radio_57k()
    order = [
        BlobKind.MAP_UPDATE,
        BlobKind.PASSED_FRAME,
        BlobKind.FRAME_ANSWER,
        BlobKind.POSE_REQUEST,
    ]
    for kind in order:
        network.drones[1].submit(2, kind, BLOB[:8000], network.now_s)
    network.run(200.0, stop=lambda: len(network.ends()) == 4)
    came = [e.kind for e in network.events(2, BlobReceived) if isinstance(e, BlobReceived)]
    assert came[:2] == [BlobKind.POSE_REQUEST, BlobKind.FRAME_ANSWER]
    assert set(came[2:]) == {BlobKind.MAP_UPDATE, BlobKind.PASSED_FRAME}


def test_three_maps_leave_room_for_a_request() -> None:
    network = radio_57k()
    for k in range(6):
        network.drones[1].submit(2, BlobKind.MAP, BLOB[k:], network.now_s)
    network.run(105.0)
    network.drones[1].submit(2, BlobKind.POSE_REQUEST, BLOB[:5000], network.now_s)
    network.run(110.0)
    assert network.blobs(2) == [BLOB[:5000]]


def test_a_map_arrives_though_there_is_always_something_more_urgent() -> None:
    network = radio_57k()
    one = network.drones[1]
    transfer_id = one.submit(2, BlobKind.MAP, BLOB[:5000], network.now_s)
    number = 0
    while not network.blobs(2) and network.now_s < 160.0:
        for peer in range(2, 12):
            number += 1
            one.post(peer, proposal(number))
            one.post(peer, FrameRequest(number, 0, 0.0))
        network.run(network.now_s + 0.2)
    assert network.blobs(2) == [BLOB[:5000]]
    assert network.n_bytes > 5 * 5000
    one.cancel(transfer_id)


def test_turns_are_by_urgency_and_nobody_is_passed_over_for_ever() -> None:
    turns = Turns()
    served = [turns.next(list(Urgency)) for _ in range(1000)]
    assert served[0] == Urgency.POSE_ANSWER
    shares = [served.count(urgency) / len(served) for urgency in Urgency]
    assert shares[0] > 0.35
    assert min(shares) > 0.09
    assert Turns().next([Urgency.MAP, Urgency.FRAME]) == Urgency.FRAME


def test_a_newer_message_takes_the_place_of_one_that_waits() -> None:
    transfers = Transfers(DEFAULTS, np.random.default_rng(0))
    for number in range(1000):
        transfers.post(0, NO_MAP)
        transfers.post(2, FrameRequest(number, 0, 0.0))
        transfers.post(3, FrameRequest(number, 0, 0.0))
        transfers.post(2, proposal(number))
    assert transfers.next_poll_s() == float("-inf")
    outgoing, _ = transfers.poll(0.0)
    assert [(out.peer, decode_payload(out.payload_type, out.payload)) for out in outgoing] == [
        (2, proposal(999)),
        (0, NO_MAP),
        (2, FrameRequest(999, 0, 0.0)),
        (3, FrameRequest(999, 0, 0.0)),
    ]
    assert transfers.next_poll_s() is None


@pytest.mark.parametrize(("copies", "n_chunks"), [(1, 51), (20, 43)])
def test_a_message_to_all_is_counted_as_often_as_the_link_sends_it(
    copies: int, n_chunks: int
) -> None:
    transfers = Transfers(DEFAULTS, np.random.default_rng(0))
    transfers.reaches_all_with(copies)
    for _ in range(3):
        transfers.post(0, NO_MAP)
    transfers.submit(2, BlobKind.MAP, BLOB, 0.0)
    outgoing, _ = transfers.poll(0.0)
    messages = [decode_payload(out.payload_type, out.payload) for out in outgoing]
    left_bytes = 8192 - copies * (33 + 30)
    assert sum(isinstance(message, Chunk) for message in messages) == left_bytes // 158 == n_chunks


@pytest.mark.parametrize(("profile", "baud"), [("radio-57k", 57_600), ("radio-115k", 115_200)])
def test_a_radio_is_never_given_more_than_it_takes(profile: Profile, baud: int) -> None:
    pace = PROFILES[profile]
    assert 0.6 * baud / 10 < pace.rate_bytes_per_s < 0.8 * baud / 10
    assert pace.burst_bytes / (baud / 10) < 0.06  # seconds that something urgent waits for
    assert TransferOptions(profile=profile).pace == pace


def test_what_is_given_goes_before_the_profile() -> None:
    pace = TransferOptions("radio-57k", rate_bytes_per_s=2000.0, give_up_s=90.0).pace
    usual = PROFILES["radio-57k"]
    assert (pace.rate_bytes_per_s, pace.give_up_s) == (2000.0, 90.0)
    assert (pace.burst_bytes, pace.status_interval_s) == (
        usual.burst_bytes,
        usual.status_interval_s,
    )
