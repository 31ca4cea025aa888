"""A frame's own fix: looked for by the map from where the drone is believed, and taken in."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.mishaps import fix_or_none
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.pipeline import (
    Effort,
    PipelineOptions,
    follow_own_views,
    is_doubtful,
    localize,
)
from vcl_companion.mapping.templates import Templates
from vcl_companion.recording.sensor import Sensor

# How long an attitude sample may still be on its way when its frame is here.
ATTITUDE_WAIT_S = 0.1
# How often features are asked about a pose that few patches agree on.
_DOUBT_EVERY_S = 5.0
_PATCHES_ALONE = Effort(may_search=False, may_doubt=False)


@dataclass(frozen=True, eq=False)
class Look:
    """What one look at a frame has given.

    Attributes:
        stored: the map that it was looked at on.
        ned_from_body: (3, 3) the frame's attitude, or None.
        fix: where it was taken, or why that cannot be said.
        began_at_s: by the loop's time.
        local: the local map that it was looked at on as well, if it was.
    """

    stored: StoredMap
    ned_from_body: Array | None
    fix: Localized | NotLocalized
    began_at_s: float
    local: Templates | None = None

    @property
    def seen(self) -> Templates | None:
        """What the fix rests on; None for features."""
        is_on_map = isinstance(self.fix, NotLocalized) or self.fix.is_on_map
        return self.stored.templates if is_on_map else self.local


class OwnFixes:
    """Looks at frames beside the event loop, and brings the state up to what they give.

    Args:
        sensor: the camera's calibration and mounting.
        autopilot: gives attitude.
        maps: the current map.
        estimator: the pose filter.
        log: told of every fix.
        executor: runs the vision.
        options: of the steps.
        odometry: knows our own last frames, to go on by.
    """

    def __init__(
        self,
        sensor: Sensor,
        autopilot: AutopilotLink,
        maps: MapStore,
        estimator: Estimator,
        log: FlightLog,
        executor: Executor,
        options: PipelineOptions,
        odometry: Odometry,
    ) -> None:
        self._sensor = sensor
        self._autopilot = autopilot
        self._maps = maps
        self._estimator = estimator
        self._log = log
        self._executor = executor
        self._options = options
        self._odometry = odometry
        self._doubted_at_s = -math.inf

    async def run(self) -> None:
        """Make local maps of our own frames when they are wanted, until cancelled."""
        await self._odometry.run()

    async def look(self, frame: Frame, stored: StoredMap) -> Look:
        """Look at a frame on a map: by its patches, or all over it where it has none.

        Where the world of that map is left meanwhile, on the one that is in use then; where all is
        forgotten that it was led by, once more. Where it hardly shows the frame, by our own last
        frames.
        """
        while True:
            n_forgotten = self._estimator.n_forgotten
            ned_from_body = await self.attitude_at(frame.captured_at_ns)
            now_s = asyncio.get_running_loop().time()
            may_doubt = now_s >= self._doubted_at_s + _DOUBT_EVERY_S
            effort = Effort(may_search=stored.templates is None, may_doubt=may_doubt)
            fix = await self._localized(frame, stored, ned_from_body, effort)
            look = Look(stored, ned_from_body, fix, now_s)
            if self._still_counts(stored, n_forgotten):
                if isinstance(fix, Localized) and is_doubtful(fix):
                    self._doubted_at_s = now_s
                look = await self._by_odometry(frame, look) or look
            if self._still_counts(stored, n_forgotten):  # after that was looked at, too
                return look
            stored = self._maps.current or stored

    def _still_counts(self, stored: StoredMap, n_forgotten: int) -> bool:
        """Whether what a frame has given counts still: its world, and what it was led by, do."""
        is_in_world = not self._maps.has_left_world(stored.world)
        return is_in_world and self._estimator.n_forgotten == n_forgotten

    async def _by_odometry(self, frame: Frame, on_map: Look) -> Look | None:
        """Look at a frame by our own last frames, if these may tell more; None if they do not."""
        world = self._world_of(on_map.stored)
        local = self._odometry.templates_in(world)
        at_ns, ned_from_body = frame.captured_at_ns, on_map.ned_from_body
        if local is None and isinstance(on_map.fix, NotLocalized):
            local = await self._odometry.begun(world)
        if local is None or not self._odometry.may_tell_more(on_map.fix):
            return None
        predicted = self._estimator.predicted(at_ns, ned_from_body)
        if predicted is None:
            return None
        options = self._options.by_heading(self._estimator.has_heading)
        own: Localized | NotLocalized = NotLocalized("not looked for")
        for prior in predicted.priors_on_own_views():
            own = await self._looked(
                follow_own_views,
                frame.image,
                self._sensor.camera,
                self._sensor.body_from_cam,
                local,
                prior,
                ned_from_body,
                options,
            )
            if isinstance(own, Localized):
                break
        if isinstance(own, NotLocalized) or not self._odometry.tells_more(own, on_map.fix):
            return None
        return replace(on_map, fix=own, local=local)

    async def look_by_patches(self, frame: Frame, prior: Prior | None = None) -> Look | None:
        """Look at a frame by patches alone, once.

        Args:
            frame: which.
            prior: where it was taken; None: where the drone is believed to have been.

        Returns:
            What that gave; None without a map that has some, or where its world was left meanwhile,
            or what led it forgotten.
        """
        stored = self._maps.current
        if stored is None or stored.templates is None:
            return None
        ned_from_body = await self.attitude_at(frame.captured_at_ns)
        now_s, n_forgotten = asyncio.get_running_loop().time(), self._estimator.n_forgotten
        fix = await self._localized(frame, stored, ned_from_body, _PATCHES_ALONE, prior)
        if not self._still_counts(stored, n_forgotten):
            return None
        return Look(stored, ned_from_body, fix, now_s)

    async def attitude_at(self, at_ns: int) -> Array | None:
        """Return (3, 3) ned_from_body by the autopilot at the instant of a frame, or None."""
        attitude = await self._autopilot.attitudes.at(at_ns, ATTITUDE_WAIT_S)
        return None if attitude is None else attitude.ned_from_body

    async def _localized(
        self,
        frame: Frame,
        stored: StoredMap,
        ned_from_body: Array | None,
        effort: Effort,
        prior: Prior | None = None,
    ) -> Localized | NotLocalized:
        """Return what a frame gives from a pose, or from where the drone is believed to be then."""
        predicted = self._estimator.predicted(frame.captured_at_ns, ned_from_body)
        if prior is None and predicted is not None:
            prior = predicted.prior()
        return await self._looked(
            localize,
            frame.image,
            self._sensor.camera,
            self._sensor.body_from_cam,
            stored.index,
            stored.templates,
            prior,
            ned_from_body,
            self._options,
            replace(effort, has_heading=self._estimator.has_heading),
        )

    async def _looked(
        self, look: Callable[..., Localized | NotLocalized], *args: object
    ) -> Localized | NotLocalized:
        """Have a frame looked at beside the event loop."""
        loop = asyncio.get_running_loop()
        return await fix_or_none(loop.run_in_executor(self._executor, look, *args))

    def note(self, frame: Frame, look: Look) -> None:
        """Remember a frame whose fix was taken: we may have to go on by it."""
        seen = look.seen
        if isinstance(look.fix, Localized) and look.fix.by != "features" and seen is not None:
            self._odometry.note(frame, look.fix, seen, self._world_of(look.stored))

    def _world_of(self, stored: StoredMap) -> tuple[bytes, int]:
        """Return which world poses on a map are in, and how often we have begun in it anew."""
        return stored.world, self._estimator.n_displaced

    def take(
        self, frame: Frame, fix: Localized, ned_from_body: Array | None
    ) -> FilterState | NotLocalized:
        """Bring the state up to a frame's fix; or say why that is not believed.

        What a frame shows of the map counts once: one that waited for it may have been followed,
        one that is followed may have been looked for all over the map meanwhile.
        """
        at_ns = frame.captured_at_ns
        known = self._estimator.own_fix_at(at_ns)
        if known is not None and fix.is_on_map:
            return known
        # Again, not as it was before the vision: a proposal may have come meanwhile.
        predicted = self._estimator.predicted(at_ns, ned_from_body)
        n_displaced = self._estimator.n_displaced
        state = self._estimator.take_fix(predicted, fix, at_ns, ned_from_body)
        is_displaced = self._estimator.n_displaced > n_displaced
        if is_displaced and predicted is not None and isinstance(state, FilterState):
            self._displaced(predicted, state)
        refused = state if isinstance(state, NotLocalized) else None
        self._log.estimate(
            at_ns,
            fix.world_from_body,
            fix.covariance(),
            fused=refused is None,
            reason=refused.reason if refused else "",
        )
        return state

    def _displaced(self, believed: FilterState, state: FilterState) -> None:
        """Have our own frames' poses go along from where we were believed to be."""
        stored, at = self._maps.current, state.world_from_body
        if stored is not None:
            by = at @ believed.world_from_body.inverse()
            self._odometry.displaced(by, at, state.pose_covariance(), self._world_of(stored))

    def take_nothing(self, frame: Frame, ned_from_body: Array | None) -> None:
        """Bring the state up to a frame that gave no fix."""
        at_ns = frame.captured_at_ns
        predicted = self._estimator.predicted(at_ns, ned_from_body)
        self._estimator.take_nothing(predicted, at_ns, ned_from_body)
