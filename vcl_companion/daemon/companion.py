"""From frame to pose: the straight line that everything else only feeds."""

from __future__ import annotations

import asyncio
import logging
import math
import weakref
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from vcl_companion.cameras.source import CameraSource, Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import Basis, FlightLog, PoseSource
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.frame_waits import FrameWaits
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.inter_target import Asked, InterTarget
from vcl_companion.daemon.mailbox import FramesBehind, Mailbox
from vcl_companion.daemon.map_search import MapSearch, Sought
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.teller import Teller
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pipeline import Effort, PipelineOptions, is_doubtful, localize
from vcl_companion.localization.proposals import NotFused
from vcl_companion.recording.sensor import Sensor
from vcl_companion.wire.pose_messages import PoseProposal

_log = logging.getLogger(__name__)

# How long an attitude sample may still be on its way when its frame is here.
ATTITUDE_WAIT_S = 0.1
# How long the last frames of a stream may take.
_LAST_FRAMES_S = 5.0
# How often features are asked about a pose that few patches agree on.
_DOUBT_EVERY_S = 5.0
_PATCHES_ALONE = Effort(may_search=False, may_doubt=False)
# A third of a megabyte each.
_MAX_BEHIND = 16


@dataclass(frozen=True, eq=False)
class _AskedPeers:
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


class Companion:
    """Takes the newest frame, localizes it, sends the pose; one frame at a time.

    A frame that has to be looked for by its features takes as long as ten others: it is, and
    is answered, beside those that follow it. These are followed from where it was, one after
    the other up to the newest: by then that one is too far from it to be found at once.

    Args:
        camera: where frames come from.
        outcomes: where each is answered.
        sensor: the camera's calibration and mounting.
        autopilot: gives attitude.
        teller: tells it poses.
        maps: the current map.
        estimator: the pose filter.
        inter: asks peers where we are.
        on_frame: shown every frame as it arrives (the exchange keeps some for peers).
        health: told while a frame waits for a map.
        log: told of every estimate.
        executor: runs the vision, beside the event loop.
        work: searches the map for a frame that patches do not place, beside both.
        options: of the steps.
        frame_wait_s: how long a frame that the map does not know waits for the next
            map, which it may have gone into itself, while no newer frame comes.
    """

    def __init__(
        self,
        camera: CameraSource,
        outcomes: FrameOutcomes,
        sensor: Sensor,
        autopilot: AutopilotLink,
        teller: Teller,
        maps: MapStore,
        estimator: Estimator,
        inter: InterTarget,
        on_frame: Callable[[Frame], None],
        health: Health,
        log: FlightLog,
        executor: Executor,
        work: MapWork,
        options: PipelineOptions,
        frame_wait_s: float,
    ) -> None:
        self._camera = camera
        self._outcomes = outcomes
        self._sensor = sensor
        self._autopilot = autopilot
        self._teller = teller
        self._maps = maps
        self._estimator = estimator
        self._inter = inter
        self._on_frame = on_frame
        self._health = health
        self._log = log
        self._executor = executor
        self._options = options
        self._mailbox = Mailbox()
        self._waits = FrameWaits(self._mailbox, maps, health, frame_wait_s)
        self._map_search = MapSearch(self._mailbox, maps, estimator, work)
        self._doubted_at_s = -math.inf
        self._behind: FramesBehind[NotLocalized] = FramesBehind(_MAX_BEHIND)

    async def read_camera(self) -> None:
        """Move frames from the camera to the mailbox until the stream ends and all are answered.

        A frame that still waits for a first map then is answered at once, one
        that is being localized when that is done.
        """
        async for frame in self._camera.frames():
            self._outcomes.opened(frame)
            self._teller.arrived(frame.captured_at_ns)
            replaced = self._mailbox.put(frame)
            if replaced is not None:
                self._drop(replaced)
            self._on_frame(frame)
        _log.info("the camera's stream is over")
        self._waits.stream_is_over()
        await self._outcomes.all_answered(_LAST_FRAMES_S)

    async def run(self) -> None:
        """Localize frames until cancelled."""
        async with asyncio.TaskGroup() as beside:
            beside.create_task(self._teller.run())
            while True:
                await self._take_next(beside)

    async def _take_next(self, beside: asyncio.TaskGroup) -> None:
        """Localize the next frame; what is left to do for it is done beside those after it."""
        frame = await self._mailbox.take()
        stored = self._maps.current or await self._first_map(frame)
        if stored is None:
            return
        left = await self._localize(frame, stored)
        if left is not None:
            beside.create_task(self._finish(left))

    async def _first_map(self, frame: Frame) -> StoredMap | None:
        """Wait for a first map as long as no newer frame comes; answer the frame if none does."""
        await self._waits.first_map(frame)
        if self._maps.current is None:
            self._outcomes.refuse(frame, self._waits.no_map())
        return self._maps.current

    async def _localize(self, frame: Frame, stored: StoredMap) -> Sought | _AskedPeers | None:
        """Localize a frame by the map, and answer it unless features or peers are asked as well.

        Returns:
            What they are asked; None when nobody is and the frame is answered.
        """
        ned_from_body = await self._attitude_of(frame)
        now_s = asyncio.get_running_loop().time()
        follows = stored.templates is not None
        may_doubt = now_s >= self._doubted_at_s + _DOUBT_EVERY_S
        effort = Effort(may_search=not follows, may_doubt=may_doubt)
        fix = await self._looked_at(frame, stored, ned_from_body, effort)
        if self._maps.has_left_world(stored.world):
            return await self._localize(frame, self._maps.current or stored)
        if isinstance(fix, Localized) and is_doubtful(fix):
            self._doubted_at_s = now_s
        refused = self._take(frame, fix, ned_from_body)
        if isinstance(fix, Localized) or not follows:
            self._estimator.in_sight.seen_on = stored.revision
        if isinstance(fix, NotLocalized) and follows:
            search = self._map_search
            if search.is_under_way:
                # What is found there leads this frame too, if it is still the newest then.
                await self._waits.unless_newer(frame, search.ended())
                if not (search.is_under_way or self._mailbox.has_had_newer(frame)):
                    return await self._localize(frame, self._maps.current or stored)
            elif search.is_due(stored, now_s):
                return search.begin(frame, ned_from_body, stored, now_s)
        return await self._ask(frame, ned_from_body, stored, refused)

    async def _attitude_of(self, frame: Frame) -> Array | None:
        attitude = await self._autopilot.attitudes.at(frame.captured_at_ns, ATTITUDE_WAIT_S)
        return None if attitude is None else attitude.ned_from_body

    async def _looked_at(
        self, frame: Frame, stored: StoredMap, ned_from_body: Array | None, effort: Effort
    ) -> Localized | NotLocalized:
        """Return what a frame gives from where the drone is believed to have been then."""
        predicted = self._estimator.predicted(frame.captured_at_ns, ned_from_body)
        return await asyncio.get_running_loop().run_in_executor(
            self._executor,
            localize,
            frame.image,
            self._sensor.camera,
            self._sensor.body_from_cam,
            stored.index,
            stored.templates,
            predicted.prior() if predicted else None,
            ned_from_body,
            self._options,
            replace(effort, has_heading=self._estimator.has_heading),
        )

    async def _search(self, sought: Sought) -> _AskedPeers | Sought | None:
        """Look for a frame by its features; the rest is as for any other.

        What comes meanwhile is kept, and followed from where this one is found.
        """
        frame = sought.frame
        try:
            stored, fix = await self._map_search.found(sought)
            refused = self._take(frame, fix, sought.ned_from_body)
            self._estimator.in_sight.seen_on = stored.revision
            while refused is None and (behind := self._behind.take()) is not None:
                await self._look_again(*behind)
        finally:
            self._map_search.end()
            while (behind := self._behind.take()) is not None:
                self._give_up(*behind)
        return await self._ask(frame, sought.ned_from_body, stored, refused)

    async def _look_again(self, frame: Frame, refused: NotLocalized) -> None:
        """Answer a frame by what is known by now of where it was taken: later ones have been."""
        if not await self._is_placed_by_patches(frame):
            self._give_up(frame, refused)

    async def _is_placed_by_patches(self, frame: Frame) -> bool:
        """Look at a frame once more, from where it is believed by now; answer it if that helps."""
        stored = self._maps.current
        if stored is None or stored.templates is None:
            return False
        ned_from_body = await self._attitude_of(frame)
        fix = await self._looked_at(frame, stored, ned_from_body, _PATCHES_ALONE)
        if self._maps.has_left_world(stored.world):
            return False
        if isinstance(fix, NotLocalized) or self._take(frame, fix, ned_from_body) is not None:
            return False
        self._outcomes.close(frame)
        return True

    async def _ask(
        self,
        frame: Frame,
        ned_from_body: Array | None,
        stored: StoredMap,
        refused: NotLocalized | None,
    ) -> Sought | _AskedPeers | None:
        """Answer a frame that has been looked at, unless peers are asked about it.

        Nor are they while the search of an older frame, which will lead this one, has only begun.
        """
        sigma_m = math.inf if refused else self._estimator.sigma_m
        now_s = asyncio.get_running_loop().time()
        is_sought = self._estimator.in_sight.is_being_sought(now_s)
        is_led = refused is not None and self._map_search.is_behind(frame) and is_sought
        asked = None
        if not is_led:
            asked = self._inter.begin(frame, ned_from_body, stored.revision, sigma_m)
        if asked is not None:
            points_world = stored.index.landmark_map.points_world
            return _AskedPeers(asked, weakref.ref(stored), stored.world, points_world, refused)
        if refused is None:
            self._outcomes.close(frame)
            return None
        return await self._given_up(frame, stored, refused)

    async def _given_up(
        self, frame: Frame, stored: StoredMap | None, refused: NotLocalized
    ) -> Sought | _AskedPeers | None:
        """Answer a frame that nobody could place, unless something comes that may place it.

        That is a newer map, or, where an older frame is still looked for, its place.
        """
        if self._map_search.is_behind(frame):
            for let_go in self._behind.keep(frame, refused):
                self._give_up(*let_go)
            return None
        self._health.refused(refused.reason)
        newer = await self._waits.next_map(frame, stored)
        if newer is not None:
            return await self._localize(frame, newer)
        if self._mailbox.has_had_newer(frame):
            await self._look_again(frame, refused)
        else:
            self._give_up(frame, refused)
        return None

    def _take(
        self, frame: Frame, fix: Localized | NotLocalized, ned_from_body: Array | None
    ) -> NotLocalized | None:
        """Bring the state up to what the frame gave and send it; or say why there is nothing."""
        at_ns = frame.captured_at_ns
        # Again, not as it was before the vision: a proposal may have come meanwhile.
        predicted = self._estimator.predicted(at_ns, ned_from_body)
        if isinstance(fix, NotLocalized):
            self._estimator.take_nothing(predicted, at_ns, ned_from_body)
            return fix
        state = self._estimator.take_fix(predicted, fix, at_ns, ned_from_body)
        refused = state if isinstance(state, NotLocalized) else None
        self._log.estimate(
            at_ns,
            fix.world_from_body,
            fix.covariance(),
            fused=refused is None,
            reason=refused.reason if refused else "",
        )
        if isinstance(state, NotLocalized):
            return state
        return self._send(frame, state, "intra", fix.by, fix.n_matched, fix.n_inliers)

    async def _finish(self, left: Sought | _AskedPeers | None) -> None:
        """Do what is left to do for a frame, beside the frames that follow it."""
        while isinstance(left, Sought):
            left = await self._search(left)
        if left is not None:
            await self._hear_peers(left)

    async def _hear_peers(self, open_frame: _AskedPeers) -> None:
        """Fuse what peers say of a frame, answer it, and fuse what comes too late for that."""
        asked, refused = open_frame.asked, open_frame.refused
        state = again = None
        for host, proposal in await self._inter.ask(asked):
            state = self._fuse(host, proposal, open_frame) or state
        if refused is None:
            self._outcomes.close(asked.frame, None if state is None else "fused")
        elif state is None:
            again = await self._given_up(asked.frame, open_frame.stored(), refused)
        elif not await self._is_placed_by_patches(asked.frame):
            # Led by what peers said, the frame's own patches would have told it more closely.
            unsent = self._send(asked.frame, state, "inter", "peer")
            if unsent is None:
                self._outcomes.close(asked.frame)
            else:
                self._outcomes.refuse(asked.frame, unsent)
        await self._finish(again)
        for host, proposal in await self._inter.stragglers(asked):
            self._fuse(host, proposal, open_frame)

    def _fuse(
        self, host: int, proposal: PoseProposal, open_frame: _AskedPeers
    ) -> FilterState | None:
        """Fuse a proposal at its frame's own time; return the state of that instant if taken."""
        at_ns = open_frame.asked.frame.captured_at_ns
        pose, covariance = proposal.world_from_body, proposal.covariance
        state: FilterState | NotFused = NotFused("of a world that was left since")
        if not self._maps.has_left_world(open_frame.world):
            state = self._estimator.take_proposal(
                at_ns, open_frame.asked.ned_from_body, pose, covariance, open_frame.points_world
            )
        why = state.reason if isinstance(state, NotFused) else ""
        # Without a fix of our own one peer may only be said to contradict another.
        tells = not isinstance(state, NotFused) or state.contradicts
        if tells and self._estimator.last_own_fix.is_near(at_ns):
            self._inter.judged(host, why)
        self._log.estimate(at_ns, pose, covariance, fused=not why, host=host, reason=why)
        return None if isinstance(state, NotFused) else state

    def _send(
        self,
        frame: Frame,
        state: FilterState,
        source: PoseSource,
        by: Basis,
        n_matched: int = 0,
        n_inliers: int = 0,
    ) -> NotLocalized | None:
        """Send the pose of a frame, at its own time; or say why it cannot be."""
        untold = self._teller.tell(state, frame.captured_at_ns)
        if untold is not None and not untold.is_held_back:
            return NotLocalized(untold.reason, n_matched, n_inliers)
        held_back = untold.reason if untold else ""
        self._outcomes.sent(frame, source, by, n_matched, n_inliers, held_back)
        return None

    def _give_up(self, frame: Frame, why: NotLocalized) -> None:
        """Refuse a frame; while the last fix is fresh, attitude and motion still say where it is.

        Not when the autopilot has heard of a later frame: a pose of the past that
        nobody has measured is no news.
        """
        self._health.refused(why.reason)
        at_ns = frame.captured_at_ns
        state = self._estimator.coasted_at(at_ns)
        coasted = state is not None and self._teller.tell(state, at_ns) is None
        self._outcomes.refuse(frame, why, coasted=coasted)

    def _drop(self, frame: Frame) -> None:
        """Answer a frame whose place a newer one took before it was looked at."""
        if self._maps.current is None:
            self._outcomes.refuse(frame, self._waits.no_map())
        else:
            self._outcomes.drop(frame)
