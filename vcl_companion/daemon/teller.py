"""What the autopilot is told of our pose, and when: frames' poses, and between them where we are.

Between two frames the state is carried on by its velocity and by the autopilot's own attitude. That
is no news to an estimator which has had the frame's pose and has felt the motion itself: it keeps
it from taking us for gone, and must not make it surer. All poses between two frames together are
told with a tenth of the information of one, however many they are, and with next to none about
the attitude, which is the autopilot's own (``covariance_between``).
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np

from vcl_companion.clock import Clock, ManualClock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.pacer import Pacer
from vcl_companion.daemon.resets import Resets
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.texts import Severity
from vcl_companion.links.vision_pose import PoseEstimate
from vcl_companion.localization.filter_state import FilterState

_log = logging.getLogger(__name__)

# While there is no map no frame is looked at: they are not remembered for ever. Far fewer wait for
# one that is searched for.
_MOST_UNSEEN = 100
# After so long without a pose nobody knows from it where the autopilot takes us to be.
_SILENT_NS = 1_000_000_000
# Of the information of one pose, in all those between two frames.
_INFORMATION_BETWEEN = 0.1
# How well their attitude is said to be known besides, 1 sigma.
_UNKNOWN_TURN_RAD = 1.0


@dataclass(frozen=True)
class Untold:
    """A frame's pose was not told.

    Attributes:
        reason: for people.
        is_held_back: whether it is as good as any, and was not needed.
    """

    reason: str
    is_held_back: bool = False


@dataclass(frozen=True, eq=False)
class _Told:
    """A pose that was told: the state, the frame of then, and by how much it slid in that."""

    state: FilterState
    local_from_world: Similarity
    shift: Pose


class Teller:
    """Tells poses in the order of their instants; everything happens in the event loop's thread.

    Args:
        autopilot: is told, and says how it is turned.
        estimator: where we are, and the frame that the autopilot knows.
        clock: time base of the frames.
        log: told of every pose between frames.
        options: the rates, and what is done about jumps.
    """

    def __init__(
        self,
        autopilot: AutopilotLink,
        estimator: Estimator,
        clock: Clock,
        log: FlightLog,
        options: AutopilotOptions,
    ) -> None:
        self._autopilot = autopilot
        self._estimator = estimator
        self._clock = clock
        self._log = log
        self._propagate_s = options.propagate_s
        self._pacer = Pacer(options.min_rate_hz, options.max_rate_hz)
        self._unseen: list[int] = []
        self._last: _Told | None = None
        self._resets = Resets(
            options.resets,
            options.blend_speed_m_s,
            math.radians(options.blend_turn_deg_s),
            self._decided,
        )

    def allow_jump(self) -> None:
        """Let the next pose be told wherever it is: the ground has asked for it."""
        self._resets.allow()

    def arrived(self, at_ns: int) -> None:
        """Note a frame that has come: nothing later is told until it is looked at."""
        self._pacer.arrived(at_ns)
        self._unseen = [*self._still_unseen()[-_MOST_UNSEEN:], at_ns]

    def tell(self, state: FilterState, at_ns: int) -> Untold | None:
        """Tell a frame's pose at its own instant, or say why not.

        What lies before it and was not due yet is told first.
        """
        self._tell_between(at_ns)
        held_back = self._pacer.holds_back(at_ns)
        if held_back:
            self._pacer.held_back(self._clock.now_ns() - at_ns)
            return Untold(held_back, is_held_back=True)
        why_not = self._send(state, at_ns)
        if why_not is not None:
            return Untold(why_not)
        self._pacer.told(at_ns, self._clock.now_ns() - at_ns)
        return None

    async def run(self) -> None:
        """Tell what is due between frames as the autopilot's attitude of then comes in."""
        while True:
            await self._autopilot.attitudes.news()
            self._tell_between(None)

    def _tell_between(self, until_ns: int | None) -> None:
        """Tell poses between frames: those before an instant, or those that are due by now."""
        while True:
            now_ns = self._clock.now_ns()
            # A clock that is told the time leaps: nothing is late by it.
            leaps = until_ns is not None or isinstance(self._clock, ManualClock)
            between = self._pacer.next_between(None if leaps else now_ns)
            if between is None:
                return
            at_ns = between.at_ns
            if until_ns is None:
                newest_ns = self._autopilot.attitudes.newest_ns()
                if now_ns < between.due_ns or newest_ns is None or newest_ns < at_ns:
                    return
            elif self._is_too_near(at_ns, until_ns):
                return
            if any(self._is_too_near(at_ns, frame_ns) for frame_ns in self._still_unseen()):
                return
            attitude = self._autopilot.attitudes.known(at_ns)
            ned_from_body = None if attitude is None else attitude.ned_from_body
            state = self._estimator.propagated(at_ns, ned_from_body, self._propagate_s)
            if state is None:
                return
            if self._send(state, at_ns, between.share) is not None:
                return
            self._log.propagated(at_ns, (at_ns - state.fixed_at_ns) * 1e-9)
            self._pacer.told_between(at_ns)

    def _still_unseen(self) -> list[int]:
        """Return the instants of frames that have come, and were not looked at yet."""
        return [
            at_ns for at_ns in self._unseen if not self._estimator.in_sight.has_looked_at(at_ns)
        ]

    def _is_too_near(self, at_ns: int, frame_ns: int) -> bool:
        """Whether a pose between frames would come after a frame's, or leave it no room."""
        return at_ns > frame_ns - self._pacer.room_ns

    def _send(self, state: FilterState, at_ns: int, share: float | None = None) -> str | None:
        """Send a state's pose in the frame that the autopilot knows, or say why not.

        Args:
            state: of the instant.
            at_ns: the instant.
            share: see ``covariance_between``; None for a frame's pose.
        """
        if self._autopilot.poses.is_paused:
            return "paused by the ground"
        local = self._estimator.local
        if not local.settles(state):
            return "the autopilot has not said its heading"
        local_from_world = local.from_world
        pose = local_from_world.of_pose(state.world_from_body)
        metres = local_from_world.scale
        stretching = np.diag([metres] * 3 + [1.0] * 3)
        covariance = stretching @ state.pose_covariance() @ stretching
        velocity = metres**2 * state.velocity_covariance()
        if share is None:
            waits = self._placed(pose, covariance, state, at_ns)
            if waits:
                return waits
        elif not self._resets.has_seen(self._estimator.n_resets):
            return "a jump is told by a frame"
        else:
            covariance, velocity = covariance_between(covariance, velocity, share)
        told, slides_m_s = self._resets.told(pose, at_ns)
        turn = self._resets.turn @ local_from_world.rotation
        why_not = self._autopilot.poses.send(
            PoseEstimate(
                told,
                covariance,
                metres * turn @ state.velocity_world + slides_m_s,
                turn @ velocity @ turn.T,
                at_ns,
                self._resets.n_resets,
            ),
            is_of_frame=share is None,
        )
        if why_not is None:
            self._last = _Told(state, local_from_world, told @ pose.inverse())
        return why_not

    def _placed(self, pose: Pose, covariance: Array, state: FilterState, at_ns: int) -> str:
        """Decide where a frame's pose is told; return why it is not, if it is not."""
        last = self._last
        was_silent = last is not None and at_ns - last.state.at_ns > _SILENT_NS
        expected = None
        if last is not None and not was_silent:
            there = self._estimator.carried_on(last.state, at_ns, state.ned_from_body)
            if there is not None:
                expected = last.shift @ last.local_from_world.of_pose(there.world_from_body)
        else:
            position = self._autopilot.expected_at(at_ns)
            expected = None if position is None else Pose(pose.rotation, position)
        return self._resets.decide(
            pose,
            covariance,
            at_ns,
            self._estimator.n_resets,
            expected,
            self._autopilot.mode,
            was_silent=was_silent,
        )

    def _decided(self, what: str, is_for_ground: bool) -> None:
        """Say what becomes of a jump."""
        self._log.event("reset", what)
        _log.info("%s", what)
        if is_for_ground:
            self._autopilot.announce(Severity.WARNING, f"VCL {what}")


def covariance_between(pose: Array, velocity: Array, share: float) -> tuple[Array, Array]:
    """Return the covariances that a pose between frames is told with.

    Args:
        pose: (6, 6) local, with what is unknown of the motion since the last frame.
        velocity: (3, 3), the same.
        share: of the time between two frames that the pose stands for: what is told in them
            all has the information of ``_INFORMATION_BETWEEN`` of one.
    """
    wider = 1.0 / (_INFORMATION_BETWEEN * share)
    unknown = np.diag([0.0] * 3 + [_UNKNOWN_TURN_RAD**2] * 3)
    return wider * pose + unknown, wider * velocity
