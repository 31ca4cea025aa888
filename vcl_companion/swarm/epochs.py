"""Terms of coordinators: whose word is newer, where several have led one team (fencing).

An epoch is a ballot number as of Lamport's Paxos (1998): a count, and in its lowest byte who
has taken it. So two drones that know nothing of each other, in two parts of a swarm, never
take the same one, and of two any is the higher for everybody. Who begins to coordinate takes
the next above all that it knows of its team; everybody tells the highest it knows, so that a
drone that was restarted, and a coordinator that was away, hear it with the next state.

A word of one member alone fences nobody, or one wrong drone could keep all from a coordinator
that has not heard what it told them. What is *known* is what a coordinator of a team says itself,
or two members say; what anybody says (*rumour*) is only what the next epoch is taken above.

After the last number comes the first one again, and of two the higher one is that which is
reached from the other by less than half of them (serial numbers, RFC 1982): whatever a wrong
peer tells, there is a next one.
"""

from __future__ import annotations

from functools import reduce

from vcl_companion.wire.messages import MAX_EPOCH

FIRST = 0
"""The founders' own: nobody has ever been lost, and the leader coordinates, or is waited for."""

VACANT = 1
"""The leader was there and was lost; nobody has taken its place yet."""

_STEP = 1 << 8
_N_EPOCHS = MAX_EPOCH + 1


def taken_by(epoch: int) -> int:
    """Return who has taken an epoch; 0 for ``FIRST`` and ``VACANT``."""
    return epoch % _STEP if epoch > VACANT else 0


def is_before(epoch: int, other: int) -> bool:
    """Whether an epoch is lower than another; nothing that was taken is before who takes none."""
    if min(epoch, other) <= VACANT:
        return epoch < other
    return 0 < (other - epoch) % _N_EPOCHS < _N_EPOCHS // 2


def higher(epoch: int, other: int) -> int:
    """Return the higher of two; the first where neither is."""
    return other if is_before(epoch, other) else epoch


def lower(epoch: int, other: int) -> int:
    """Return the lower of two; the second where neither is."""
    return epoch if is_before(epoch, other) else other


def _next_of(own_id: int, epoch: int) -> int:
    """Return the lowest epoch of a drone above another."""
    count = (epoch // _STEP + 1) % (_N_EPOCHS // _STEP)
    return max(count, 1) * _STEP + own_id


class Epochs:
    """The highest epoch of each team that one drone knows.

    Among honest drones they never go back. A wrong one that lifts them by nearly half of all can
    have them go round; who takes the next is above all the same.

    Args:
        own_id: this drone.
    """

    def __init__(self, own_id: int) -> None:
        self._own_id = own_id
        self._known: dict[int, int] = {}  # at most one for each name of a team, 251
        self._rumoured: dict[int, int] = {}
        self._taken: dict[int, int] = {}

    def of(self, team: int) -> int:
        """Return the highest known of a team."""
        return self._known.get(team, FIRST)

    def hear(self, team: int, epoch: int) -> None:
        """Note what is known, for who says it says so rightly."""
        self._known[team] = higher(self.of(team), epoch)

    def rumour(self, team: int, epoch: int) -> None:
        """Note what somebody says: what we take will be above it."""
        self._rumoured[team] = higher(self._rumoured.get(team, FIRST), epoch)

    def is_unheard_of(self, team: int) -> bool:
        """Whether nobody has ever said that anybody but its founders led a team."""
        return self.of(team) == FIRST and self._rumoured.get(team, FIRST) == FIRST

    def is_ours(self, team: int) -> bool:
        """Whether this drone has taken the highest one, in this life of it.

        What it took before it was restarted is not: it does not know what it said under it.
        """
        return team in self._taken and self._taken[team] == self.of(team)

    def take(self, team: int) -> int:
        """Take the next one of a team, above those of all teams: names of teams come again."""
        all_ = (*self._known.values(), *self._rumoured.values())
        taken = _next_of(self._own_id, reduce(higher, all_, FIRST))
        if not is_before(self.of(team), taken):  # all teams' may be further apart than half
            taken = _next_of(self._own_id, self.of(team))
        self._taken[team] = self._known[team] = taken
        return taken
