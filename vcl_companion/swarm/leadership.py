"""Who coordinates a team, and under which epoch; whose word as a coordinator counts.

The coordinator of a team (``teams``) is the leader, where it flies with that, or, once the leader
was heard and then lost, the lowest member alive that is believed. A leader never heard is waited
for, but not for ever: at a start drones come up seconds apart, and each must not begin a map of
its own.

Who goes and comes back again and again does not lead at once (``comebacks``).

Whoever begins to coordinate takes an epoch (``epochs``); one who does it under an older one, for
it was away, is not followed until it has taken a newer one. That one is older is believed of who
coordinates, or of two, and never of one other alone. A drone that was restarted waits for the
time-out before it holds anybody for lost that it has not heard itself: until then it knows
neither who is there nor the epochs.
"""

from __future__ import annotations

from vcl_companion.swarm.comebacks import Comebacks, successor
from vcl_companion.swarm.epochs import FIRST, VACANT, Epochs, is_before, lower, taken_by
from vcl_companion.swarm.membership import Membership
from vcl_companion.wire.messages import MapState


class Leadership:
    """Who leads which team as one drone knows it; ``Group`` tells it what happens.

    Args:
        members: who is there, and what they say.
        leader: of all, as configured.
        leader_wait_s: one that was never heard is waited for so long.
    """

    def __init__(self, members: Membership, leader: int, leader_wait_s: float) -> None:
        self.leader = leader
        self._members = members
        self._presence = members.presence
        self._leader_wait_s = leader_wait_s
        self._own_id = members.own_id
        self._epochs = Epochs(members.own_id)
        self._comebacks = Comebacks()

    @property
    def coordinator(self) -> int:
        """The member of our team that builds and hands out maps; see the module."""
        members = self._members
        if self._awaits_leader and self.leader not in members.teammates:
            return self.leader
        return self._rightful(members.team, members.teammates) or self._own_id

    @property
    def is_ours(self) -> bool:
        """Whether this drone coordinates its team."""
        return self.coordinator == self._own_id

    @property
    def epoch(self) -> int:
        """The highest epoch known of our team, to be told."""
        return self._epochs.of(self._members.team)

    @property
    def own_epoch(self) -> int:
        """What this drone coordinates under; 0 where it does not, or is the leader from the start.

        Like the team, a change of it is worth telling at once.
        """
        return self.epoch if self.is_ours and self._epochs.is_ours(self._members.team) else FIRST

    @property
    def is_told(self) -> bool:
        """Whether who coordinated when that was last looked at says that it does."""
        member = self._presence.led_by
        if member == self.leader:
            return True
        state = self._members.state_of(member)
        if state is None or state.team != self._members.team:
            return False
        return taken_by(state.epoch) == member

    def coordinator_of(self, team: int) -> int | None:
        """Return who coordinates a team, None where nobody of it is there and believed."""
        if team == self._members.team:
            return self.coordinator
        return self._rightful(team, self._members.of_team(team))

    def is_fenced(self, peer: int) -> bool:
        """Whether a peer of our team knows only of an older epoch: its word may be outdated."""
        state = self._members.state_of(peer)
        return is_before(state.epoch if state else FIRST, self.epoch)

    def may_lead(self, peer: int) -> bool:
        """Whether to take maps of a peer, and do what it asks for, as our coordinator."""
        return peer == self.coordinator and not (peer != self._own_id and self.is_fenced(peer))

    def note_came(self, peer: int, now_s: float) -> None:
        """Note that a peer is there since now."""
        self._comebacks.came(peer, now_s)

    def note_lost(self, peer: int, now_s: float) -> None:
        """Note that a peer is lost."""
        self._comebacks.lost(peer, now_s)

    def hear(self, peer: int, state: MapState, before: MapState, now_s: float) -> None:
        """Take what a peer says now of itself, and of its team's epoch, after what it said before.

        Whom to believe, see ``epochs``. Who coordinates takes a newer one for whatever anybody has
        heard of: to the one who has, it is one that was away.
        """
        if _was_restarted(state, before):
            self._comebacks.restarted(peer, now_s)
        epochs, team, epoch = self._epochs, state.team, state.epoch
        if not self._members.believes(peer) or not is_before(epochs.of(team), epoch):
            return
        members = self._members.of_team(team)
        lead = self._rightful(team, members)
        if peer == lead:
            epochs.hear(team, epoch)
            return
        taker = taken_by(epoch)
        # Who comes back too often takes epochs for a place that it is not let to.
        if taker not in (lead, self._own_id) and taker in members and not self._is_settled(taker):
            return
        epochs.rumour(team, epoch)
        for other in members:
            if other not in (peer, self._own_id) and self._members.believes(other):
                told = self._epoch_told(other, team)
                # Of what it said before, none would be a lower one by half of all epochs.
                if is_before(epochs.of(team), told) and is_before(epochs.of(team), epoch):
                    epochs.hear(team, lower(epoch, told))
        if team == self._members.team and self.is_ours and is_before(epochs.of(team), epoch):
            epochs.take(team)

    def take_term(self) -> None:
        """Take an epoch when this drone has begun to coordinate, or hears of a newer one."""
        lead, team = self.coordinator, self._members.team
        # It may be there, and fly with another team, or be passed over.
        if team == 0 and lead != self.leader:
            self._epochs.hear(0, VACANT)
        # It may have taken one before we held it for the one to lead.
        if self._members.believes(lead):
            self._epochs.hear(team, self._epoch_told(lead, team))
        if lead != self._own_id or self._epochs.is_ours(team):
            return
        if team != 0 or self.epoch != FIRST:
            self._epochs.take(team)

    @property
    def _awaits_leader(self) -> bool:
        """Whether the leader, which nobody has lost yet, may still come to our team."""
        if self._members.team != 0 or self._is_leader_gone:
            return False
        # That it was lost is believed of anybody: nobody that is there is kept from leading by it.
        return self._epochs.is_unheard_of(0) or not self._presence.has_listened

    @property
    def _is_leader_gone(self) -> bool:
        """Whether the leader, unless it is there, was lost or has been waited for long enough."""
        return self._presence.has_heard(self.leader) or self._presence.has_lasted(
            self._leader_wait_s
        )

    def _rightful(self, team: int, members: tuple[int, ...]) -> int | None:
        """Return who leads a team of these members, whoever else may come; None for nobody."""
        first: int | None = self.leader
        if first not in members:
            first = next(filter(self._members.believes, members), None)
        if first is None or self._is_settled(first):
            return first
        believed = [m for m in members if self._members.believes(m)]
        order = [self.leader, *believed] if self.leader in members else believed
        for member in order:
            if self._is_settled(member):
                return member
            told = {m: self._epoch_told(m, team) for m in believed if m != member}
            other = successor(told)
            if other is not None:
                return other
            if not self._comebacks.has_restarted(member):
                return member
        return first

    def _is_settled(self, member: int) -> bool:
        return self._comebacks.is_settled(member, self._presence.now_s)

    def _epoch_told(self, member: int, team: int) -> int:
        """Return the highest epoch of its team that a member of it says that it knows."""
        if member == self._own_id:
            return self._epochs.of(team)
        state = self._members.state_of(member)
        return state.epoch if state else FIRST


def _was_restarted(state: MapState, before: MapState) -> bool:
    """Whether a member that says this after that has forgotten its map, or its team's epochs."""
    has_forgotten = before.epoch > VACANT and state.epoch == FIRST and before.team == state.team
    return has_forgotten or bool(before.revision and not state.revision)
