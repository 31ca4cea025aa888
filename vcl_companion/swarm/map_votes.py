"""Who of our team holds which map, who lacks the newest one, and who wants another (IV-G)."""

from __future__ import annotations

from collections.abc import Iterable

from vcl_companion.swarm.leadership import Leadership
from vcl_companion.swarm.membership import Membership


class MapVotes:
    """What the members of our team say of their maps; looked up, nothing is kept here.

    Args:
        members: who is there, and what they say.
        leadership: who coordinates.
    """

    def __init__(self, members: Membership, leadership: Leadership) -> None:
        self._members = members
        self._leadership = leadership

    @property
    def newest_revision(self) -> bytes:
        """The coordinator's map, empty while it has none as far as known."""
        return self._revision_of(self._leadership.coordinator)

    @property
    def is_map_coming(self) -> bool:
        """Whether our team's newest revision is another than this drone flies on."""
        return self.newest_revision not in (b"", self._revision_of(self._members.own_id))

    def has_map(self, member: int) -> bool:
        """Whether a member has said so; one on a part of a map says that it has none."""
        return bool(self._revision_of(member))

    def holders(self, revision: bytes) -> tuple[int, ...]:
        """Return the teammates that hold this revision."""
        members = self._members
        return tuple(
            m for m in members.teammates if (s := members.state_of(m)) and s.revision == revision
        )

    def lacking(self) -> tuple[int, ...]:
        """Return the teammates that do not hold the newest revision; none without one.

        Of those that are trusted, not silent, and not on a map of their own (``leave_apart``).

        A member that said nothing of its map yet lacks it.
        """
        newest = self.newest_revision
        if not newest:
            return ()
        members = self._members
        return tuple(
            m for m in members.teammates if self._revision_of(m) != newest and members.counts(m)
        )

    @property
    def wanting_update(self) -> tuple[int, ...]:
        """Teammates whose vote is for an update of the newest revision (IV-G).

        The vote of one that still flies on another revision is about that one,
        and does not count.
        """
        newest = self.newest_revision
        if not newest:
            return ()
        return tuple(m for m in self.holders(newest) if self._wants(m) and self._members.counts(m))

    @property
    def majority_wants_update(self) -> bool:
        """Whether more than half of those that have a vote (``lacking``) are for an update."""
        n_wanting = len(self.wanting_update)
        n_voters = sum(map(self._members.counts, self._members.teammates))
        return n_wanting > 0 and 2 * n_wanting > n_voters

    def most_others_hold(self, revision: bytes) -> bool:
        """Whether most of the other teammates trusted, and at least two, hold a revision."""
        others = [m for m in self._members.trusted_teammates if m != self._members.own_id]
        n_holders = len(set(others) & set(self.holders(revision)))
        return n_holders >= 2 and 2 * n_holders > len(others)

    def contributors(self, first: Iterable[int], most: int) -> tuple[int, ...]:
        """Return teammates that are believed whose frames a map is to be made of, and this drone.

        Of many not all: a map would grow, and take bytes and time, with the swarm.

        Args:
            first: who is needed most, in this order.
            most: how many, at most.

        Returns:
            Those of them that there are, then who sees least of the map.
        """

        def seen(member: int) -> int:
            state = self._members.state_of(member)
            return state.tracked if state is not None else 0

        those = set(filter(self._members.counts, self._members.teammates))
        others = sorted(those, key=lambda member: (seen(member), member))
        order = dict.fromkeys((self._members.own_id, *first, *others))
        return tuple(m for m in order if m in those)[:most]

    def _revision_of(self, member: int) -> bytes:
        state = self._members.state_of(member)
        return state.revision if state is not None else b""

    def _wants(self, member: int) -> bool:
        state = self._members.state_of(member)
        return state is not None and state.wants_update
