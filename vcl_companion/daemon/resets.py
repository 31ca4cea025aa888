"""What is done about a jump of what the autopilot is told: nothing, a reset, a slide, or a wait.

No clock and no link in here. A jump within what is told of the pose's error is one for the
estimator's own filter. A larger one it refuses (PX4 for a second, after which it gives in, five
times in the air at most; an ArduPilot for five), unless ``reset_counter`` counts it: then both
follow at once. But who flies to positions flies the other way by as much as it is reset.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Literal

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, heading_of
from vcl_companion.links.vehicle_mode import VehicleMode

ResetMode = Literal["follow", "blend", "wait"]

# 99.7 % of chi^2 with 3 degrees of freedom: what estimators' gates of five sigmas let pass.
_GATE = 14.2
# What estimators take for noise of any pose (VISO_POS_M_NSE; ArduPilot's least yaw error is 5).
_NOISE_M, _NOISE_RAD = 0.05, math.radians(2.0)
# As many as PX4 follows of itself in the air.
_MOST_RESETS = 5
_WITHIN_NS = 60_000_000_000
# After so long a slide is as fast as it gets, and so long before its end it begins to slow down. An
# autopilot feels no such motion: it swings about one that begins or ends at once, by 0.2 m where
# an ArduCopter's slides at 0.3 m/s, by 0.06 m so.
_REACHES_SPEED_S = 6.0


class Resets:
    """Where poses are told to be after a jump, and how many of those the autopilot is told of.

    Args:
        mode: what is done while the vehicle is steered by positions.
        speed_m_s: of a slide.
        turn_rad_s: of a slide's heading.
        say: told of every decision: for people, and whether the ground has to know.
    """

    def __init__(
        self, mode: ResetMode, speed_m_s: float, turn_rad_s: float, say: Callable[[str, bool], None]
    ) -> None:
        self._mode = mode
        self._speed_m_s = speed_m_s
        self._turn_rad_s = turn_rad_s
        self._say = say
        self._n_jumps: int | None = None
        self._recent: deque[int] = deque(maxlen=_MOST_RESETS)
        self._is_allowed = False
        self._shift: Pose | None = None
        self._shifted_at_ns = 0
        self._now_m_s = self._now_rad_s = 0.0
        self.n_resets = 0
        """Jumps that the autopilot is told of by ``reset_counter``."""
        self.waits_for = ""
        """What is waited for before anything is told; empty when nothing is."""

    def allow(self) -> None:
        """Let the next pose be told wherever it is: the ground says so."""
        self._is_allowed = True
        self._recent.clear()

    def has_seen(self, n_jumps: int) -> bool:
        """Whether it is decided what becomes of the last jump."""
        return self._n_jumps == n_jumps and not self.waits_for

    def decide(
        self,
        pose: Pose,
        covariance: Array,
        at_ns: int,
        n_jumps: int,
        expected: Pose | None,
        mode: VehicleMode,
        *,
        was_silent: bool,
    ) -> str:
        """Decide what becomes of a jump, if there was one since the last pose.

        After silence the autopilot has gone on by itself: who is not to be moved is not by that.

        Args:
            pose: of a frame, in the frame that the autopilot was told poses in.
            covariance: (6, 6) local, of it.
            at_ns: its instant.
            n_jumps: of the estimate, so far.
            expected: where the autopilot takes the drone to be; None when nobody knows.
            mode: how the vehicle is flown.
            was_silent: whether the last pose was told too long ago to say where it is now.

        Returns:
            Why nothing is told; empty when the pose is, where ``told`` puts it.
        """
        is_first = self._n_jumps is None
        may_move = self._mode == "follow" or not mode.is_steered_by_positions
        no_jump = self.has_seen(n_jumps) and (may_move or not was_silent)
        if no_jump or (is_first and (expected is None or not mode.is_armed)):
            self._go_on(n_jumps)
            return ""
        if expected is not None and _explains(pose, covariance, expected):
            if not is_first:
                self._say("a jump within the pose's own error: nothing is made of it", False)
            self._shift = None  # where a slide has come to, it is
            self._go_on(n_jumps)
            return ""
        away = "" if expected is None else f" {_metres(pose, expected):.1f} m away"
        self._recent_until(at_ns)
        if self._is_allowed:
            self._reset(at_ns, n_jumps, mode, f"relocalized{away}, as commanded")
        elif not may_move and self._mode == "wait":
            return self._wait(f"relocalized{away}: MAV_CMD_USER_4, or another flight mode")
        elif not may_move and expected is not None:
            self._shift, self._shifted_at_ns = _shift_between(expected, pose), at_ns
            self._now_m_s = self._now_rad_s = 0.0
            self._say(f"relocalized{away}: told poses slide there", True)
            self._go_on(n_jumps)
        elif mode.is_armed and len(self._recent) == _MOST_RESETS:
            return self._wait(f"the {_MOST_RESETS + 1}th jump in a minute: MAV_CMD_USER_4")
        else:
            self._reset(at_ns, n_jumps, mode, f"relocalized{away}")
        return ""

    def told(self, pose: Pose, at_ns: int) -> tuple[Pose, Array]:
        """Return where a pose is told to be while it slides, and the (3,) slide's speed, m/s."""
        if self._shift is None:
            return pose, np.zeros(3)
        since_s = max(at_ns - self._shifted_at_ns, 0) * 1e-9
        shift = self._shift
        before = shift @ pose
        turn_rad, self._now_rad_s = _slid(
            heading_of(shift.rotation), self._now_rad_s, self._turn_rad_s, since_s
        )
        off = before.translation - pose.translation
        length_m = float(np.linalg.norm(off))
        left_m, self._now_m_s = _slid(length_m, self._now_m_s, self._speed_m_s, since_s)
        slid = off * (left_m / length_m) if length_m > 0.0 else off
        rotation = about_down(turn_rad)
        self._shift = Pose(rotation, pose.translation + slid - rotation @ pose.translation)
        self._shifted_at_ns = max(at_ns, self._shifted_at_ns)
        speed = (slid - off) / since_s if since_s > 0.0 else np.zeros(3)
        told = self._shift @ pose
        if turn_rad == 0.0 and left_m == 0.0:
            self._shift = None
            self._say("told poses are where they should be", False)
        return told, speed

    @property
    def turn(self) -> Array:
        """(3, 3) by how much told headings are turned, while they slide."""
        return np.eye(3) if self._shift is None else self._shift.rotation

    def _recent_until(self, at_ns: int) -> None:
        while self._recent and at_ns - self._recent[0] > _WITHIN_NS:
            self._recent.popleft()

    def _go_on(self, n_jumps: int) -> None:
        self._n_jumps, self.waits_for, self._is_allowed = n_jumps, "", False

    def _reset(self, at_ns: int, n_jumps: int, mode: VehicleMode, why: str) -> None:
        if mode.is_armed:
            self._recent.append(at_ns)
        if self._n_jumps is not None:  # the counter of who is just started is another one anyway
            self.n_resets += 1
        self._shift = None
        self._say(f"{why}: the autopilot is reset", mode.is_armed)
        self._go_on(n_jumps)

    def _wait(self, what: str) -> str:
        if not self.waits_for:
            self._say(f"no poses are sent: {what}", True)
        self.waits_for = f"waiting for the ground: {what}"
        return self.waits_for


def _explains(pose: Pose, covariance: Array, expected: Pose) -> bool:
    """Whether a pose's own error explains that it is not where it was expected."""
    off = pose.local(expected)
    away, turned = off[:3], off[3:]
    position = covariance[:3, :3] + _NOISE_M**2 * np.eye(3)
    rotation = covariance[3:, 3:] + _NOISE_RAD**2 * np.eye(3)
    return bool(
        away @ np.linalg.solve(position, away) <= _GATE
        and turned @ np.linalg.solve(rotation, turned) <= _GATE
    )


def _shift_between(told: Pose, pose: Pose) -> Pose:
    """Return what carries a pose to where another is, its roll and pitch as they are.

    The turn is not the difference of two yaws: of who dives these tell of any small turn.
    """
    rotation = about_down(heading_of(told.rotation @ pose.rotation.T))
    return Pose(rotation, told.translation - rotation @ pose.translation)


def _metres(pose: Pose, other: Pose) -> float:
    return float(np.linalg.norm(pose.translation - other.translation))


def _slid(left: float, speed: float, most: float, since_s: float) -> tuple[float, float]:
    """Return what is left to go so much later, and how fast that went.

    Args:
        left: to go, of either sign.
        speed: it went by until now.
        most: it may go by.
        since_s: how much later.
    """
    change = most / _REACHES_SPEED_S
    half = 0.5 * change * since_s
    slowing = math.sqrt(half**2 + 2.0 * change * abs(left)) - half
    speed = min(speed + 2.0 * half, most, slowing)
    return math.copysign(max(abs(left) - speed * since_s, 0.0), left), speed
