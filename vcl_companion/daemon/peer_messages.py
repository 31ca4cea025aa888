"""One payload of a peer: decoded, refused for what it is or who says it, or given to its taker."""

from __future__ import annotations

import asyncio

from vcl_companion.daemon.deliveries import Deliveries
from vcl_companion.daemon.frame_answers import FrameAnswers
from vcl_companion.daemon.inter_target import InterTarget
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.peer_presence import PeerPresence
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.daemon.refusals import Refusals
from vcl_companion.errors import WireError
from vcl_companion.links.messages import Tunnel
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import Transfers
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import PoseProposal, PoseRefused
from vcl_companion.wire.tunnel import TunnelPayload, decode_payload, is_ours


class PeerMessages:
    """Takes what peers say, one payload at a time; nothing that one holds raises.

    Args:
        group: who coordinates.
        transfers: takes pieces of blobs.
        deliveries: what these come to.
        presence: takes what a peer says of itself.
        answers: takes requests for our frames.
        maps: told why there is no map.
        inter: takes poses that it asked for.
        trust: who is not believed.
        refusals: counts what is not taken.
    """

    def __init__(
        self,
        group: Group,
        transfers: Transfers,
        deliveries: Deliveries,
        presence: PeerPresence,
        answers: FrameAnswers,
        maps: MapStore,
        inter: InterTarget,
        trust: PeerTrust,
        refusals: Refusals,
    ) -> None:
        self._group = group
        self._transfers = transfers
        self._deliveries = deliveries
        self._presence = presence
        self._answers = answers
        self._maps = maps
        self._inter = inter
        self._trust = trust
        self._refusals = refusals

    def take(self, tunnel: Tunnel) -> bool:
        """Take one payload; whatever is wrong with it is counted.

        Returns:
            Whether there may be something to do, or to say, for it.
        """
        if not is_ours(tunnel.payload_type):
            return False
        try:
            message = decode_payload(tunnel.payload_type, tunnel.payload)
        except WireError as error:
            self._trust.malformed(tunnel.sender_system, "payload", error)
            return False
        return self._accept(tunnel.sender_system, message, to_all=tunnel.target_system == 0)

    def _accept(self, peer: int, message: TunnelPayload, *, to_all: bool) -> bool:
        if not isinstance(message, Chunk | TransferStatus):
            self._trust.heard(peer)
            if not isinstance(message, MapState) and self._trust.bars(peer, "message"):
                return False
        match message:
            case Chunk() | TransferStatus():
                now_s = asyncio.get_running_loop().time()
                events = self._transfers.receive(peer, message, now_s, to_all=to_all)
                self._deliveries.take(events)
            case MapState():
                # Most say what was said before, and in a large swarm that would be all the work.
                return self._presence.map_state(peer, message)
            case FrameRequest():
                if not self._answers.want(
                    peer, message, leads=self._group.leadership.may_lead(peer)
                ):
                    self._refusals.count(peer, "frames asked for too often for no coordinator")
                    return False
            case MapRefused():
                if peer == self._group.coordinator:
                    self._maps.refuse(message.reason)
            case PoseProposal() | PoseRefused():
                refusal = self._inter.take(peer, message)
                if refusal is not None:
                    self._refusals.count(peer, refusal)
        return True
