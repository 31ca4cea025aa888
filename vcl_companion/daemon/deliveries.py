"""What transfers come to: a blob that is complete goes to who it is for, and its sender may go on.

Here it is bytes still. Those of a peer that is not believed are refused, and those of a frame
are decoded; maps and requests for poses wait as they are for who takes them.
"""

from __future__ import annotations

import asyncio
import logging

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_answers import FrameAnswers
from vcl_companion.daemon.inter_host import InterHost
from vcl_companion.daemon.map_rounds import MapRounds
from vcl_companion.daemon.map_sharing import MapSharing
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.daemon.refusals import Refusals
from vcl_companion.errors import WireError
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import (
    BlobDelivered,
    BlobHeld,
    BlobKind,
    BlobReceived,
    Event,
    TransferFailed,
)
from vcl_companion.wire.chunks import describe
from vcl_companion.wire.frame_codec import decode_frame

_log = logging.getLogger(__name__)


class Deliveries:
    """Takes what became of transfers.

    Args:
        group: whether frames are ours to make a map of.
        rounds: takes frames that it asked for.
        answers: told which of its answers have arrived.
        passed: keeps frames for a map that is still to come.
        sharing: takes maps.
        host: takes requests for poses.
        trust: whose frames are not taken.
        refusals: counts what is not.
        log: told of what failed.
    """

    def __init__(
        self,
        group: Group,
        rounds: MapRounds,
        answers: FrameAnswers,
        passed: PassedFrames,
        sharing: MapSharing,
        host: InterHost,
        trust: PeerTrust,
        refusals: Refusals,
        log: FlightLog,
    ) -> None:
        self._group = group
        self._rounds = rounds
        self._answers = answers
        self._passed = passed
        self._sharing = sharing
        self._host = host
        self._trust = trust
        self._refusals = refusals
        self._log = log

    def take(self, events: list[Event]) -> None:
        """Take what happened to transfers, in its order."""
        for event in events:
            match event:
                case BlobReceived(peer=peer, kind=BlobKind.FRAME_ANSWER, blob=blob):
                    self._take_frame(peer, blob)
                case BlobReceived(
                    peer=peer,
                    kind=(BlobKind.MAP | BlobKind.MAP_UPDATE | BlobKind.MAP_PART) as kind,
                    blob=blob,
                ):
                    self._sharing.offer(peer, kind, blob)
                case BlobReceived(peer=peer, kind=BlobKind.POSE_REQUEST, blob=blob):
                    self._host.offer(peer, blob)
                case BlobReceived(peer=peer, kind=BlobKind.PASSED_FRAME, blob=blob):
                    self._take_passed(peer, blob)
                case BlobHeld(peer=peer, digest=digest):
                    self._passed.is_held(peer, digest)
                case BlobDelivered(peer=peer, transfer_id=transfer_id):
                    self._answers.ended(peer, transfer_id, delivered=True)
                    self._passed.ended(peer, transfer_id, delivered=True)
                    now_s = asyncio.get_running_loop().time()
                    self._sharing.handing.delivered(peer, transfer_id, now_s)
                case TransferFailed(peer=peer, transfer_id=transfer_id, reason=reason):
                    self._answers.ended(peer, transfer_id, delivered=False)
                    self._passed.ended(peer, transfer_id, delivered=False)
                    self._log.event("transfer", f"to drone {peer}: {reason}")
                    _log.warning("transfer to drone %d failed: %s", peer, reason)

    def _take_frame(self, peer: int, blob: bytes) -> None:
        if self._trust.bars(peer, "frame"):
            return
        try:
            frame = decode_frame(blob)
        except WireError as error:
            self._trust.malformed(peer, "frame", error)
            return
        if frame.drone_id == peer and not self._group.is_coordinator:
            self._passed.hold(frame)
            return
        refusal = self._rounds.take(peer, frame)
        if refusal is not None:
            self._refusals.count(peer, refusal)
            return
        self._passed.answered(frame, describe(BlobKind.FRAME_ANSWER, blob).short_digest)

    def _take_passed(self, peer: int, blob: bytes) -> None:
        if self._trust.bars(peer, "frame"):
            return
        if peer != self._group.coordinator:
            # Who has led until now does not know yet.
            self._refusals.count(peer, "passed frame", "not by the coordinator")
            return
        try:
            self._passed.take(blob)
        except WireError as error:
            self._trust.malformed(peer, "passed frame", error)
