"""What peers say of where a frame was taken: asked about it, fused at its own time."""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.inter_target import Asked, InterTarget
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import NotLocalized
from vcl_companion.localization.proposals import NotFused
from vcl_companion.wire.pose_messages import PoseProposal


@dataclass(frozen=True, eq=False)
class AskedPeers:
    """A frame that peers are asked about.

    Attributes:
        asked: the request.
        stored: the map that was flown on. Its answers come seconds later: by then it may have
            been left, and is not to be kept in memory for them.
        world: that it is of.
        points_world: (N, 3) landmarks of it, m.
        refused: why the frame itself gave no pose; None where it did.
    """

    asked: Asked
    stored: weakref.ref[StoredMap]
    world: bytes
    points_world: Array
    refused: NotLocalized | None

    @property
    def frame(self) -> Frame:
        """The frame."""
        return self.asked.frame


class PeerPoses:
    """Has peers say where frames were taken, and fuses what is believed of it.

    Args:
        inter: asks them; told which of their answers fit what we know ourselves.
        maps: the current map.
        estimator: the pose filter.
        log: told of every proposal.
    """

    def __init__(
        self, inter: InterTarget, maps: MapStore, estimator: Estimator, log: FlightLog
    ) -> None:
        self._inter = inter
        self._maps = maps
        self._estimator = estimator
        self._log = log

    def begin(
        self,
        frame: Frame,
        ned_from_body: Array | None,
        stored: StoredMap,
        refused: NotLocalized | None,
    ) -> AskedPeers | None:
        """Decide whether peers are asked about a frame; they are by ``hear``.

        Args:
            frame: the newest.
            ned_from_body: (3, 3) its attitude, or None.
            stored: the map that it was looked at on.
            refused: why that gave no pose; None where it did.

        Returns:
            What they are asked; None where nobody is.
        """
        sigma_m = math.inf if refused else self._estimator.sigma_m
        asked = self._inter.begin(frame, ned_from_body, stored.revision, sigma_m)
        if asked is None:
            return None
        points_world = stored.index.landmark_map.points_world
        return AskedPeers(asked, weakref.ref(stored), stored.world, points_world, refused)

    async def hear(self, asked_peers: AskedPeers) -> FilterState | None:
        """Ask, and fuse what comes in time; return the state of that instant if any was taken."""
        state: FilterState | None = None
        for host, proposal in await self._inter.ask(asked_peers.asked):
            state = self.fuse(host, proposal, asked_peers) or state
        return state

    async def hear_late(self, asked_peers: AskedPeers) -> None:
        """Fuse what comes too late to answer the frame, as long as it can be."""
        for host, proposal in await self._inter.stragglers(asked_peers.asked):
            self.fuse(host, proposal, asked_peers)

    def fuse(
        self, host: int, proposal: PoseProposal, asked_peers: AskedPeers
    ) -> FilterState | None:
        """Fuse a proposal at its frame's own time; return the state of that instant if taken."""
        at_ns = asked_peers.frame.captured_at_ns
        pose, covariance = proposal.world_from_body, proposal.covariance
        state: FilterState | NotFused = NotFused("of a world that was left since")
        if not self._maps.has_left_world(asked_peers.world):
            state = self._estimator.take_proposal(
                at_ns, asked_peers.asked.ned_from_body, pose, covariance, asked_peers.points_world
            )
        why = state.reason if isinstance(state, NotFused) else ""
        # Without a fix of our own one peer may only be said to contradict another.
        tells = not isinstance(state, NotFused) or state.contradicts
        if tells and self._estimator.last_own_fix.is_near(at_ns):
            self._inter.judged(host, why)
        self._log.estimate(at_ns, pose, covariance, fused=not why, host=host, reason=why)
        return None if isinstance(state, NotFused) else state
