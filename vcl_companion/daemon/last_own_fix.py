"""Our last own fix, and where it lets us be: what peers propose is held against it."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.localization.filter_state import FilterState, carried

# A fix this old is no more where we are.
FRESH_NS = 2_000_000_000
# Nobody flies faster than so many sigmas of the speed, nor is further from where he was.
_FASTEST_SIGMAS = 5.0
# So much further is no contradiction, however small the sigmas are.
_LEAST_AWAY_M = 1.0
# Parts of a pose's covariance; and no sigma is smaller, m or rad, so that it has an inverse.
_METRES, _RADIANS = slice(0, 3), slice(3, 6)
_LEAST_SIGMA = 1e-6


class LastOwnFix:
    """The state after the last frame that gave a fix of its own; none at first.

    Args:
        speed_m_s: 1 sigma of how fast we fly.
    """

    def __init__(self, speed_m_s: float) -> None:
        self._speed_m_s = speed_m_s
        self._state: FilterState | None = None
        self._surest = np.full(6, np.inf)

    def note(self, state: FilterState) -> None:
        """Take the state after a frame that gave a fix; an older one changes nothing."""
        if self._state is None or state.at_ns >= self._state.at_ns:
            self._state = state
        covariance = state.pose_covariance()
        for part in (_METRES, _RADIANS):
            least = float(np.linalg.eigvalsh(covariance[part, part])[0])
            self._surest[part] = np.minimum(self._surest[part], np.sqrt(max(least, 0.0)))

    def forget(self) -> None:
        """Know of none any more."""
        self._state = None
        self._surest[:] = np.inf

    def carry(self, other_from_world: Similarity) -> None:
        """Go on in another world."""
        if self._state is not None:
            self._state = carried(self._state, other_from_world)
        self._surest[_METRES] *= other_from_world.scale

    def is_near(self, at_ns: int) -> bool:
        """Whether it is not two seconds from an instant, and so says where we were then."""
        return self._state is not None and abs(at_ns - self._state.at_ns) <= FRESH_NS

    def no_surer(self, covariance: Array) -> Array:
        """Return a covariance as it is if no surer than ours ever was, else as sure as that.

        What a peer says of where we are rests on the same map, another one's pose in it and what
        is between us: it cannot be known better than what our own frames have shown. Who says so
        would take the place of what we know, and of what our next frames say.

        Args:
            covariance: (6, 6) local, of a pose.
        """
        if not np.isfinite(self._surest).all():
            return covariance
        units = np.maximum(self._surest, _LEAST_SIGMA)
        values, vectors = np.linalg.eigh(covariance / np.outer(units, units))
        if values[0] >= 1.0:
            return covariance
        widened = (vectors * np.maximum(values, 1.0)) @ vectors.T
        return np.asarray(widened * np.outer(units, units))

    def too_far(self, at_ns: int, world_from_body: Pose, covariance: Array) -> str:
        """Say how a pose cannot be reached from it; empty if it can, or if there is none.

        The filter's own gate widens with the square of the time, and there is none where it
        has begun anew; soon after a fix it is the narrower one, and nothing is said here.

        Args:
            at_ns: instant of the pose.
            world_from_body: the pose.
            covariance: (6, 6) local, of it.
        """
        own = self._state
        if own is None or self.is_near(at_ns):
            return ""
        away = world_from_body.translation - own.world_from_body.translation
        metres = float(np.linalg.norm(away))
        since_s = abs(at_ns - own.at_ns) * 1e-9
        spread = own.pose_covariance()[:3, :3] + covariance[:3, :3]
        sigma_m = worst_sigma(spread)
        reach_m = _FASTEST_SIGMAS * (self._speed_m_s * since_s + sigma_m)
        if metres <= reach_m + _LEAST_AWAY_M:
            return ""
        return f"{metres:.1f} m from our last own fix, {since_s:.1f} s away from it"
