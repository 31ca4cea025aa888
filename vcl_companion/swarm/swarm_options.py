"""The group as it is configured: who is in it, who leads, what is known at the start."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vcl_companion.errors import ConfigError

# Drones show themselves every second.
_LEAST_TIMEOUT_S = 2.0
_MAX_MEMBER_ID = 250


@dataclass(frozen=True)
class SwarmOptions:
    """The group as it is configured, the same on every drone.

    Attributes:
        members: system ids of all drones; empty for a drone alone.
        leader: one of them; 0 for the lowest.
        known_distances: (a, b, m): distance between two drones when the first map is made, m.
        heartbeat_timeout_s: silent for this long is lost; in a large swarm for longer (``pace``).
        leader_wait_s: how long a leader that was never heard is waited for; then the others
            make a world of their own.
        split_after_s: members who see nothing of what their coordinator sees for so long
            become a team of their own, with the map they have; 0 for never.
        rejoin_after_s: teams that see the same place for so long become one again.
        keeps_local: a drone whose map is merged into one of another world goes on telling its
            autopilot poses in the frame that this knows; else in the other world, a jump that
            ``reset_counter`` tells.
    """

    members: tuple[int, ...] = ()
    leader: int = 0
    known_distances: tuple[tuple[int, int, float], ...] = ()
    heartbeat_timeout_s: float = 5.0
    leader_wait_s: float = 60.0
    split_after_s: float = 30.0
    rejoin_after_s: float = 3.0
    keeps_local: bool = True

    def __post_init__(self) -> None:
        for member in self.members:
            if not 1 <= member <= _MAX_MEMBER_ID:
                raise ConfigError(f"members: {member} is not a system id of 1 to {_MAX_MEMBER_ID}")
        if len(set(self.members)) != len(self.members):
            raise ConfigError(f"members: {list(self.members)} names a drone twice")
        if self.leader and self.leader not in self.members:
            raise ConfigError(f"leader: {self.leader} is not one of members {list(self.members)}")
        timeout_s = self.heartbeat_timeout_s
        if not (math.isfinite(timeout_s) and timeout_s >= _LEAST_TIMEOUT_S):
            raise ConfigError(f"heartbeat_timeout_s: {timeout_s}, and at least {_LEAST_TIMEOUT_S}")
        if not (math.isfinite(self.leader_wait_s) and self.leader_wait_s > 0):
            raise ConfigError(f"leader_wait_s: {self.leader_wait_s} is not positive")
        for name in ("split_after_s", "rejoin_after_s"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigError(f"{name}: {getattr(self, name)} is negative or not finite")
        pairs: set[frozenset[int]] = set()
        for a, b, distance_m in self.known_distances:
            row = f"known_distances: [{a}, {b}, {distance_m}]"
            for member in (a, b):
                if member not in self.members:
                    raise ConfigError(f"{row}: {member} is not one of {list(self.members)}")
            if a == b:
                raise ConfigError(f"{row} is not between two drones")
            if not (math.isfinite(distance_m) and distance_m > 0):
                raise ConfigError(f"{row}: a distance must be finite and positive, in metres")
            if frozenset((a, b)) in pairs:
                raise ConfigError(f"{row} gives a distance twice")
            pairs.add(frozenset((a, b)))
