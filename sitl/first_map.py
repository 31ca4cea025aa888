"""When a recording's first map can be made, and of whose frames.

A daemon makes it of its own newest frame and of those that the others took within a second of that.
So the leader has to be there, and two whose distance is known; who begins within a second of them
is waited for as well, whoever begins later joins a map that there is by then. Frames from before
are of a time in which nobody could be localized, and a round of them would end without a map, or
with one of another moment than the distance is of: but for each drone's newest they are left out,
and that too where it is too old.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.daemon.frame_history import FURTHEST_NS
from vcl_companion.errors import ConfigError
from vcl_companion.recording import Drone, KnownPair

_Times = Mapping[str, NDArray[np.int64]]


@dataclass(frozen=True)
class Beginning:
    """When the recording stands still for the first map.

    Attributes:
        at_ns: the instant.
        drones: names of those whose newest frame of then it may be made of.
    """

    at_ns: int
    drones: frozenset[str]


def beginning(drones: Sequence[Drone], leader: str, pairs: Sequence[KnownPair]) -> Beginning:
    """Return when the first map can be made: as soon as one pair is there with the leader.

    Args:
        drones: those whose daemons run from the start.
        leader: whose place is the origin; the first of them in its stead if it is none of them.
        pairs: whose distance is known; those of others do not count.

    Raises:
        ConfigError: the leader and a pair never have frames within a second; names them.
    """
    times = {drone.name: instants_of(drone) for drone in drones}
    origin = leader if leader in times else drones[0].name
    # One that flies alone, or whose pairs all come late, waits for nobody.
    needed = [{origin, p.a, p.b} for p in pairs if {p.a, p.b} <= times.keys()] or [{origin}]
    found = [(_together_ns(times, who, origin, 0), who) for who in needed]
    possible = [(at_ns, who) for at_ns, who in found if at_ns is not None]
    if not possible:
        raise ConfigError(
            f"{', '.join(sorted(needed[0]))}: have no frames within a second of each other, "
            "and a first map is made of such"
        )
    at_ns, who = min(possible, key=lambda one: one[0])
    latest_ns = at_ns + FURTHEST_NS
    soon = [int(t[0]) for t in times.values() if t[0] <= latest_ns]
    with_them_ns = _together_ns(times, who, origin, max(at_ns, *soon))
    # Where the leader pauses until then its frame is too old for theirs: nobody else is waited for.
    if (
        with_them_ns is not None
        and with_them_ns <= latest_ns
        and with_them_ns - _newest_ns(times[origin], with_them_ns) <= FURTHEST_NS
    ):
        at_ns = with_them_ns
    origin_ns = _newest_ns(times[origin], at_ns)
    there = {name: _newest_ns(t, at_ns) for name, t in times.items() if t[0] <= at_ns}
    near = (name for name, ns in there.items() if abs(ns - origin_ns) <= FURTHEST_NS)
    return Beginning(at_ns, frozenset(near))


def n_before(drone: Drone, begins: Beginning, *, is_late: bool) -> int:
    """Return how many of a drone's frames are left out: one is always flown.

    Args:
        drone: whose frames.
        begins: when the recording waits for the first map.
        is_late: whether the drone's daemon comes later, and is given what there is then.
    """
    n_come = int(np.searchsorted(instants_of(drone), begins.at_ns, side="right"))
    if drone.name in begins.drones or is_late:
        return max(n_come - 1, 0)
    # Who pauses then is one who begins later.
    return min(n_come, len(drone.frames) - 1)


def instants_of(drone: Drone) -> NDArray[np.int64]:
    """Return the (F,) instants of a drone's frames."""
    return np.array([frame.at_ns for frame in drone.frames], dtype=np.int64)


def _together_ns(times: _Times, who: Collection[str], origin: str, since_ns: int) -> int | None:
    """Return the first instant at which drones' newest frames go with one's; None for never."""
    instants = np.unique(np.concatenate([*times.values()]))
    instants = instants[instants >= max(since_ns, *(int(times[name][0]) for name in who))]
    newest = {name: _newest(times[name], instants) for name in who}
    apart = np.array([np.abs(ns - newest[origin]) for ns in newest.values()])
    together = np.flatnonzero(np.all(apart <= FURTHEST_NS, axis=0))
    return int(instants[together[0]]) if len(together) else None


def _newest(times: NDArray[np.int64], instants: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the last of a drone's instants up to each of others, none before its first."""
    newest: NDArray[np.int64] = times[np.searchsorted(times, instants, side="right") - 1]
    return newest


def _newest_ns(times: NDArray[np.int64], at_ns: int) -> int:
    return int(_newest(times, np.array([at_ns]))[0])
