"""Where the images of a flight come from: a recording's files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from sitl.pacing import Instant
from sitl.swarm import Swarm


class Shots(Protocol):
    """What the cameras of a flight see."""

    held_s: float
    """For how long taking images has held time altogether, wall clock."""

    async def taken(self, moment: Instant, swarm: Swarm) -> Mapping[int, bytes]:
        """Return the encoded images of the drones that take one at a moment, by drone."""
        ...

    def is_over(self, swarm: Swarm) -> bool:
        """Return whether nothing more is to come, though it might."""
        ...


class RecordedShots:
    """A recording's images, as they were taken."""

    held_s = 0.0

    async def taken(self, moment: Instant, swarm: Swarm) -> Mapping[int, bytes]:
        """Return the files' contents of those whose daemon is there to see them."""
        return {
            due.drone: swarm.drones[due.drone].planned.drone.frames[due.sequence].path.read_bytes()
            for due in moment.frames
            if swarm.drones[due.drone].camera.is_connected
        }

    def is_over(self, swarm: Swarm) -> bool:
        """Return False: a recording is flown to its end."""
        return False
