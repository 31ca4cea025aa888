"""How often the members of a swarm show themselves: in all they say no more in a large one.

Everybody hears everybody: signs of life at one pace would have bytes on the air, and the work of
hearing them, grow with the swarm. As the reports of RTCP (RFC 3550, section 6.2) they come the more
rarely the more members there are, and in all no oftener than those of 16 at full pace. What is news
is told at once, and again for some seconds. Who coordinates shows itself at full pace in any swarm,
for it is to be replaced soon when it is lost; all do while somebody joins.
"""

from __future__ import annotations

FULL_PACE_S = 1.0
# So many drones hear each other's signs of life at full pace for a third of a percent of a core.
_MOST_AT_FULL_PACE = 16
_LOOK_S, _LONGEST_LOOK_S = 0.1, 0.5


def stretch_of(n_members: int) -> float:
    """Return how many times as rarely each of so many members shows itself, 1 in a small swarm.

    By the members that are configured, who are the same on every drone: who waits for a sign of
    life goes by the pace of who gives it.
    """
    return max(1.0, n_members / _MOST_AT_FULL_PACE)


def look_s(stretch: float) -> float:
    """Return how long after one look through all the others the next comes, at such a pace."""
    return min(_LOOK_S * stretch, _LONGEST_LOOK_S)
