"""Whether the autopilot uses our poses: what it says of its estimator, and whether it follows us.

No socket, no clock. That messages arrive says nothing: an estimator that takes its position from
elsewhere, or holds it for constant, hears them as well. Fused is what has a position by its own
word and by what it says of where it is (autopilots.md of the design notes; EKF_STATUS_REPORT and
ESTIMATOR_STATUS of the MAVLink message definitions).
"""

from __future__ import annotations

import enum
from collections import deque
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.links.messages import EstimatorStatus
from vcl_companion.links.vision_pose import Firmware

# Poses older than this say nothing of where it should be now.
_MEMORY_NS = 3_000_000_000
# Nothing was sent for so long: it flies without us.
_SILENT_NS = 1_000_000_000
# An estimator that has said nothing for so long does not tell of itself.
_UNTOLD_NS = 3_000_000_000
# A PX4 takes our poses once it knows our clock; an ArduPilot within two seconds.
_BEGINS_NS = 10_000_000_000
# Another state has to last before it is told: one report is a hiccup.
_LASTS_NS = 1_000_000_000
# How far its position may be from ours, besides five of our sigmas: it has an opinion of its own,
# and a delay of our poses that it does not know of.
_APART_M, _SIGMAS, _DELAY_S = 0.5, 5.0, 0.25
_MAX_KEPT = 256
# How far from its last report of its position it is taken to fly on as it did.
_EXPECTED_NS = 500_000_000
# What squares of level speed have to add up to before the delay is told: 20 s at 1 m/s and 5 Hz.
_TELLS_OF_DELAY_M2_S2 = 100.0
_FORGETS = 0.999
# PX4's EV_MAX_INTERVAL (EKF/common.h): poses further apart do not make it begin.
_PX4_BEGINS_WITHIN_S = 0.2


class FusionState(enum.Enum):
    """What becomes of our poses."""

    WAITING = "waiting"
    SENDING = "sending"
    FUSED = "fused"
    REJECTED = "rejected"
    LOST = "lost"


@dataclass(frozen=True)
class Fusion:
    """What becomes of our poses, and why.

    Attributes:
        state: which of five.
        reason: for people; empty where there is nothing to say.
    """

    state: FusionState
    reason: str = ""


@dataclass(frozen=True, eq=False)
class _Sent:
    at_ns: int
    position: Array
    sigma_m: float
    n_resets: int


@dataclass(frozen=True, eq=False)
class _Believed:
    at_ns: int
    position: Array
    velocity: Array


class FusionMonitor:
    """Compares what the autopilot says of itself with what it was sent."""

    def __init__(self) -> None:
        self.firmware = Firmware.OTHER
        self.forget()

    def forget(self) -> None:
        """Begin again: the autopilot has restarted."""
        self._sent: deque[_Sent] = deque(maxlen=_MAX_KEPT)
        self._believed: deque[_Believed] = deque(maxlen=_MAX_KEPT)
        self._status: EstimatorStatus | None = None
        self._status_at_ns = 0
        self._first_sent_ns: int | None = None
        # Of frames and between them.
        self._instants: deque[int] = deque(maxlen=_MAX_KEPT)
        self._told = Fusion(FusionState.WAITING)
        self._other_since_ns: int | None = None
        self._ahead_m2_s = self._flown_m2_s2 = 0.0
        self._compared_ns = 0

    @property
    def ahead_s(self) -> float | None:
        """By how much its level position is of a later instant, s; None before enough was flown.

        It takes our poses for so much older than they are: what its parameter of their delay
        (``VISO_DELAY_MS``, ``EKF2_EV_DELAY``) is too large by.
        """
        if self._flown_m2_s2 < _TELLS_OF_DELAY_M2_S2:
            return None
        return self._ahead_m2_s / self._flown_m2_s2

    def sent(self, at_ns: int, position: Array, sigma_m: float, n_resets: int = 0) -> None:
        """Note a pose that the autopilot was sent, its instant and its largest sigma.

        Args:
            at_ns: our clock.
            position: (3,) local NED, m.
            sigma_m: of its worst direction.
            n_resets: jumps of our frame so far.
        """
        if self._first_sent_ns is None:
            self._first_sent_ns = at_ns
        self._instants.append(at_ns)
        self._sent.append(_Sent(at_ns, position, sigma_m, n_resets))

    def sent_between(self, at_ns: int) -> None:
        """Note that it was sent a pose that no frame gave: we are not silent, and no more."""
        self._instants.append(at_ns)

    def reported(self, status: EstimatorStatus, at_ns: int) -> None:
        """Note what its estimator says of itself."""
        self._status, self._status_at_ns = status, at_ns

    def believes(self, at_ns: int, position: Array, velocity: Array) -> None:
        """Note where it believes to be: local NED, at an instant of our clock."""
        if self._believed and at_ns <= self._believed[-1].at_ns:
            return
        self._believed.append(_Believed(at_ns, position, velocity))
        self._compare_delay()

    def expected_at(self, at_ns: int) -> Array | None:
        """Return (3,) where it takes the drone to be at an instant; None when it does not know."""
        status = self._status
        if status is None or status.holds_position or not status.has_position:
            return None
        if not self._believed or abs(at_ns - self._believed[-1].at_ns) > _EXPECTED_NS:
            return None
        last = self._believed[-1]
        return last.position + (at_ns - last.at_ns) * 1e-9 * last.velocity

    def state(self, now_ns: int) -> Fusion:
        """Return what becomes of our poses; another state than before once it has lasted."""
        seen = self._seen(now_ns)
        if seen.state is self._told.state or self._is_at_once(seen.state):
            self._told, self._other_since_ns = seen, None
        elif self._other_since_ns is None:
            self._other_since_ns = now_ns
        elif now_ns - self._other_since_ns >= _LASTS_NS:
            self._told, self._other_since_ns = seen, None
        return self._told

    def _is_at_once(self, state: FusionState) -> bool:
        """Tell what was waited for at once, and what has gone wrong when it stays so."""
        return state is FusionState.FUSED or self._told.state is FusionState.WAITING

    def _seen(self, now_ns: int) -> Fusion:
        if self._first_sent_ns is None:
            return Fusion(FusionState.WAITING)
        if now_ns - max(self._instants) > _SILENT_NS:
            return Fusion(FusionState.LOST, "nothing was sent for a second or more")
        status = self._status
        if status is None or now_ns - self._status_at_ns > _UNTOLD_NS:
            return Fusion(FusionState.SENDING, "it says nothing of its estimator")
        if status.holds_position or not status.has_position:
            what = "holds its position for constant" if status.holds_position else "has no position"
            begins = now_ns - self._first_sent_ns < _BEGINS_NS
            state = FusionState.SENDING if begins else FusionState.REJECTED
            return Fusion(state, f"its estimator {what}{self._too_seldom()}")
        if status.position_test_ratio is not None and status.position_test_ratio > 1.0:
            return Fusion(FusionState.REJECTED, "our position fails the test of its estimator")
        return self._followed(now_ns)

    def _too_seldom(self) -> str:
        """Say so where our poses are too far apart for it to begin; else nothing."""
        if self.firmware is not Firmware.PX4 or len(self._instants) < 2:
            return ""
        apart_s = float(np.median(np.diff(sorted(self._instants)))) * 1e-9
        if apart_s < _PX4_BEGINS_WITHIN_S:
            return ""
        return f": ours come {1.0 / apart_s:.1f} times a second, it begins with more than 5"

    def _followed(self, now_ns: int) -> Fusion:
        """Say whether its position follows ours."""
        off, allowed, n_resets = [], [], []
        for sent in self._sent:
            if now_ns - sent.at_ns > _MEMORY_NS:
                continue
            there = self._believed_at(sent.at_ns)
            if there is not None:
                speed_m_s = float(np.linalg.norm(there.velocity))
                off.append(there.position - sent.position)
                allowed.append(_APART_M + _SIGMAS * sent.sigma_m + _DELAY_S * speed_m_s)
                n_resets.append(sent.n_resets)
        if not off:
            return Fusion(FusionState.SENDING, "it does not say where it is")
        off_m = np.array(off)
        # A barometer's height counts from elsewhere: it has to go as ours goes, between our jumps.
        for one in set(n_resets):
            alike = np.array(n_resets) == one
            off_m[alike, 2] -= np.median(off_m[alike, 2])
        newest = -max(1, len(off) // 3)
        distances_m = np.linalg.norm(off_m[newest:], axis=1)
        if float(np.median(distances_m / np.array(allowed[newest:]))) > 1.0:
            distance_m = float(np.median(distances_m))
            return Fusion(FusionState.REJECTED, f"its position is {distance_m:.1f} m from ours")
        return Fusion(FusionState.FUSED)

    def _believed_at(self, at_ns: int) -> _Believed | None:
        """Return where it believed to be at an instant between two of its reports."""
        after = None
        for one in reversed(self._believed):
            if one.at_ns <= at_ns:
                if after is None:
                    return one if one.at_ns == at_ns else None
                share = (at_ns - one.at_ns) / (after.at_ns - one.at_ns)
                between = one.position + share * (after.position - one.position)
                return _Believed(at_ns, between, one.velocity)
            after = one
        return None

    def _compare_delay(self) -> None:
        """Take the newest pose that its reports enclose into what is known of the delay."""
        if self._told.state is not FusionState.FUSED:
            return
        for sent in self._sent:
            if sent.at_ns <= self._compared_ns:
                continue
            there = self._believed_at(sent.at_ns)
            if there is None:
                continue
            self._compared_ns = sent.at_ns
            velocity, ahead_m = there.velocity[:2], (there.position - sent.position)[:2]
            self._ahead_m2_s = _FORGETS * self._ahead_m2_s + float(velocity @ ahead_m)
            self._flown_m2_s2 = _FORGETS * self._flown_m2_s2 + float(velocity @ velocity)
