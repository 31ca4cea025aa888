"""What peers say, and what is said to them: frames and votes for maps, maps, and poses.

What comes from peers enters here only (``peer_messages``, ``deliveries``), bounded and checked by
``wire`` and ``swarm``; it can replace the map, propose a pose, and nothing else. Nothing is done
for a peer while its payload is taken in: what it asks for waits in a mailbox of its own. What is
said leaves by the ``outbox``. Here these are joined, and kept going.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.answer_hearers import AnswerHearers
from vcl_companion.daemon.deliveries import Deliveries
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_answers import FrameAnswers
from vcl_companion.daemon.frame_choice import FrameChoice
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.inter_host import InterHost
from vcl_companion.daemon.inter_target import InterTarget
from vcl_companion.daemon.map_rounds import MapRounds, RoundOptions
from vcl_companion.daemon.map_sharing import MapSharing
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_trial import MapTrial
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import survived
from vcl_companion.daemon.outbox import Outbox
from vcl_companion.daemon.own_state import OwnState
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.daemon.peer_messages import PeerMessages
from vcl_companion.daemon.peer_presence import PeerPresence
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.daemon.place_signature import keep_place_known
from vcl_companion.daemon.refusals import Refusals
from vcl_companion.daemon.round_results import RoundResults
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerLink
from vcl_companion.mapping.options import MapOptions
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pace import look_s
from vcl_companion.swarm.pose_requests import HostChoice, InterMavOptions
from vcl_companion.swarm.quarantine import QuarantineOptions
from vcl_companion.swarm.transfer import BlobKind, Transfers
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.vision.features import Detector


@dataclass(frozen=True)
class ExchangeOptions:
    """What the exchange is tuned by; see each of them. ``tracked``: maps by their patches.

    ``clock_resolution_ns`` is that of the members' clocks (``PeerTime``).
    """

    swarm: SwarmOptions
    map: MapOptions
    update: UpdateOptions
    detectors: tuple[Detector, ...]
    inter: InterMavOptions
    tracked: bool
    clock_resolution_ns: int = 0
    quarantine: QuarantineOptions = field(default_factory=QuarantineOptions)


class Exchange:
    """One drone's dealings with its peers; everything happens in the event loop's thread.

    Args:
        system_id: this drone.
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        autopilot: for the attitude that goes with a frame.
        sensor: of our camera.
        clock: time base of frames.
        log: told of maps and peers.
        work: makes maps, encodes our frames, and looks for peers' poses.
        disk: writes maps.
        estimator: where this drone is, and whether it knows.
        options: of the steps.
        rng: numbers our requests.
    """

    def __init__(
        self,
        system_id: int,
        group: Group,
        transfers: Transfers,
        maps: MapStore,
        autopilot: AutopilotLink,
        sensor: Sensor,
        clock: Clock,
        log: FlightLog,
        work: MapWork,
        disk: Executor,
        estimator: Estimator,
        options: ExchangeOptions,
        rng: np.random.Generator,
    ) -> None:
        self._group = group
        self._work = work
        self._outbox = Outbox(transfers)
        self._refusals = Refusals(log)
        self.trust = PeerTrust(
            group,
            autopilot,
            estimator,
            log,
            self._refusals,
            lambda peer: self.inter.lost(peer),
            options.quarantine,
        )
        self.clocks = PeerClocks(
            group,
            self._outbox.ask_time,
            clock,
            log,
            self._refusals.count,
            options.clock_resolution_ns,
        )
        self.frames = FrameHistory()
        """Our own of the last seconds."""
        self._in_sight = estimator.in_sight
        estimator.keep_of(self.frames.has)
        choice = FrameChoice(system_id, self.frames, maps, estimator, clock)
        self._passed = PassedFrames(
            group,
            partial(self._outbox.hand, BlobKind.PASSED_FRAME),
            transfers.cancel,
            work,
            lambda: transfers.shares_network,
        )
        self._answers = FrameAnswers(
            system_id,
            choice,
            maps,
            autopilot,
            estimator,
            sensor,
            clock,
            self.clocks,
            log,
            work,
            AnswerHearers(group, transfers, maps, self._outbox).hand,
            transfers.cancel,
            self._passed.hold,
            transfers.image_bytes,
        )
        self._own_state = OwnState(
            group, maps, estimator, sensor, clock, log, options.update, self._outbox.send
        )
        self._sharing = MapSharing(
            group,
            transfers,
            maps,
            log,
            work,
            disk,
            self._own_state.tell,
            self._refusals.count,
            self.trust,
            self._passed,
            options.update.delivery_wait_s,
            len(options.detectors) > 1,
            MapTrial(self.frames, maps, estimator, work),
            estimator.carry,
            lambda: self._rounds.is_under_way,
        )
        self.results = RoundResults(
            group,
            maps,
            self._sharing.own_maps,
            self._outbox.send,
            log,
            autopilot.announce,
            clock,
        )
        self._rounds = MapRounds(
            group,
            self.frames,
            choice,
            maps,
            self._answers.describe,
            self._answers.detail,
            self._outbox.send,
            self.results.decide,
            self._passed,
            transfers.frames_carried_in_s,
            lambda: transfers.is_receiving(BlobKind.MAP, self._now_s()),
            lambda: self._sharing.merging.is_under_way,
            log,
            clock,
            self.clocks,
            work,
            RoundOptions(options.map, options.update),
            rng,
        )
        self.inter = InterTarget(
            system_id,
            HostChoice(group),
            sensor,
            clock,
            work,
            partial(self._outbox.hand, BlobKind.POSE_REQUEST),
            transfers.cancel,
            estimator.for_peers,
            transfers.carried_in_s,
            self.trust.judged,
            options.inter,
            rng,
            only_the_surer=options.tracked,
        )
        self._inter_host = InterHost(
            maps,
            self.frames,
            estimator,
            self._outbox.send,
            self.trust.malformed,
            self.trust.why_not,
            clock,
            self.clocks,
            work,
            options.inter.detector,
            options.detectors,
            tries_all=options.tracked,
        )
        self._presence = PeerPresence(
            group,
            self._sharing.handing,
            self._passed,
            self.clocks,
            self._own_state,
            self.inter,
            log,
        )
        self._deliveries = Deliveries(
            group,
            self._rounds,
            self._answers,
            self._passed,
            self._sharing,
            self._inter_host,
            self.trust,
            self._refusals,
            log,
        )
        self._messages = PeerMessages(
            group,
            transfers,
            self._deliveries,
            self._presence,
            self._answers,
            maps,
            self.inter,
            self.trust,
            self._refusals,
        )

    @property
    def refused(self) -> Mapping[str, int]:
        """What was not accepted from peers so far, counted by kind."""
        return self._refusals.by_kind

    def attach(self, link: PeerLink) -> None:
        """Give the link to speak on; it calls what begins with ``on``, and ``clocks``."""
        self._outbox.attach(link)

    def on_frame(self, frame: Frame) -> None:
        """Keep a frame of our own for peers, and for a first map."""
        self.frames.add(frame, self._in_sight.shown_well_at_ns)

    def on_heartbeat(self, peer: int) -> None:
        """Note a sign of life."""
        self._presence.heartbeat(peer)

    def on_tunnel(self, tunnel: Tunnel) -> None:
        """Take one payload of a peer; whatever is wrong with it is counted, never raised."""
        if self._messages.take(tunnel):
            self._outbox.wake()

    async def run(self) -> None:
        """Keep transfers, states and rounds going until cancelled; a failure in one ends all."""
        async with asyncio.TaskGroup() as parts:
            parts.create_task(self.clocks.run())
            parts.create_task(self._rounds.run())
            parts.create_task(self._answers.run())
            parts.create_task(self._passed.run())
            parts.create_task(self._sharing.run())
            parts.create_task(self._inter_host.run())
            parts.create_task(keep_place_known(self._group, self.frames, self._work))
            parts.create_task(self._keep_going())

    async def _keep_going(self) -> None:
        looked_at_s = -math.inf
        while True:
            now_s = self._now_s()
            # In a small swarm at every turn: these are a look apart, or there is news.
            if now_s >= looked_at_s + look_s(self._group.stretch - 1.0):
                looked_at_s = now_s
                with survived("looking after peers"):
                    self._presence.poll(now_s)
            with survived("dealing with peers"):
                self.trust.poll()
                self._own_state.poll(now_s)
                self._sharing.handing.hand_out(now_s)
            with survived("taking what peers have sent"):
                self._deliveries.take(self._outbox.poll())
            await self._outbox.pause(now_s)

    def want_update(self, wanted: bool) -> None:
        """Want the map updated, or not any more, because the ground does."""
        self._own_state.is_asked_for_update = self._rounds.is_asked = wanted

    @property
    def update_options(self) -> UpdateOptions:
        """When we want the map updated; changing them changes our vote, and nobody else's."""
        return self._own_state.update_options

    @update_options.setter
    def update_options(self, options: UpdateOptions) -> None:
        self._own_state.update_options = options

    async def go_back_to(self, data: bytes) -> str:
        """Fly on a map that was saved; return why it cannot be used, or nothing."""
        return await self._sharing.own_maps.go_back_to(data)

    @property
    def update_progress(self) -> int:
        """How far the update is that this drone makes, percent; 255 where it makes none."""
        return self._rounds.progress

    def is_busy(self) -> bool:
        """Return whether a map is being extended or on its way, or a vote for that may be.

        For who flies us in a simulation, and can hold the time until we are not.
        """
        now_s = self._now_s()
        self._own_state.poll(now_s)  # a frame may just have been answered
        return (
            self._rounds.is_coming
            or self._sharing.merging.is_under_way
            or bool(self._group.maps.lacking())
            or self._own_state.is_undecided(now_s)
        )

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
