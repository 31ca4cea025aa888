"""Terms of coordinators: whose word is newer, where several have led one team (fencing).

An epoch is a ballot number as of Lamport's Paxos (1998): a count, and in its lowest byte who
has taken it. So two drones that know nothing of each other, in two parts of a swarm, never
take the same one, and of two any is the higher for everybody. Who begins to coordinate takes
the next above all that it knows of its team; everybody tells the highest it knows, so that a
drone that was restarted, and a coordinator that was away, hear it with the next state.
"""

from __future__ import annotations

from vcl_companion.wire.messages import MAX_EPOCH

FIRST = 0
"""The founders' own: nobody has ever been lost, and the leader coordinates, or is waited for."""

VACANT = 1
"""The leader was there and was lost; nobody has taken its place yet."""

_STEP = 1 << 8


def taken_by(epoch: int) -> int:
    """Return who has taken an epoch; 0 for ``FIRST`` and ``VACANT``."""
    return epoch % _STEP


def _next_of(own_id: int, epoch: int) -> int:
    """Return the lowest epoch of a drone above another; at the end of all numbers that one."""
    above = (epoch // _STEP + 1) * _STEP + own_id
    return above if above <= MAX_EPOCH else epoch


class Epochs:
    """The highest epoch of each team that one drone knows; they never go back.

    Args:
        own_id: this drone.
    """

    def __init__(self, own_id: int) -> None:
        self._own_id = own_id
        self._highest: dict[int, int] = {}  # at most one for each name of a team, 251
        self._taken: dict[int, int] = {}

    def of(self, team: int) -> int:
        """Return the highest known of a team."""
        return self._highest.get(team, FIRST)

    def hear(self, team: int, epoch: int) -> None:
        """Note what somebody knows."""
        if epoch > self.of(team):
            self._highest[team] = epoch

    def is_ours(self, team: int) -> bool:
        """Whether this drone has taken the highest one, in this life of it.

        What it took before it was restarted is not: it does not know what it said under it.
        """
        return team in self._taken and self._taken[team] == self.of(team)

    def take(self, team: int) -> int:
        """Take the next one of a team, above those of all teams: names of teams come again."""
        highest = max(self._highest.values(), default=FIRST)
        self._taken[team] = self._highest[team] = _next_of(self._own_id, highest)
        return self._taken[team]
