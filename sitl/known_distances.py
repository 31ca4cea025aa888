"""Which distances between drones a flight's daemons are told, and how long these are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sitl.first_map import instants_of
from vcl_companion.errors import ConfigError
from vcl_companion.recording import Drone, KnownPair, Recording


def parse_known_distance(text: str) -> KnownPair:
    """Return what ``mav0:mav1=1.63`` or ``mav0:mav1`` says.

    Raises:
        ConfigError: it has another form.
    """
    names, equals, metres = text.partition("=")
    a, colon, b = (part.strip() for part in names.partition(":"))
    try:
        if colon and a and b:
            return KnownPair(a, b, float(metres) if equals else None)
    except ValueError:
        pass
    raise ConfigError(f"--known-distance {text}: expected two drones, like mav0:mav1=1.63 (metres)")


def known_pairs(
    recording: Recording,
    drones: Sequence[Drone],
    given: Sequence[KnownPair],
    late: Mapping[str, float],
) -> Sequence[KnownPair]:
    """Return the pairs whose distance is known.

    Args:
        recording: knows some.
        drones: those that fly.
        given: instead of the recording's, if any.
        late: whose daemons come in which second.

    Raises:
        ConfigError: there are none, or what is given does not fit; one line, says what would.
    """
    names = [drone.name for drone in drones]
    for pair in given:
        for name in (pair.a, pair.b):
            if name not in names:
                raise ConfigError(f"--known-distance: {name!r} does not fly ({', '.join(names)})")
        if sum({pair.a, pair.b} == {other.a, other.b} for other in given) > 1:
            raise ConfigError(f"--known-distance {pair.a}:{pair.b}: is given twice")
    pairs = given or [p for p in recording.known_distances if {p.a, p.b} <= set(names)]
    if not given and any({p.a, p.b} & late.keys() for p in pairs):
        # How far who comes late is away then nobody has measured.
        there = [d.name for d in drones if d.name not in late and d.truth is not None][:2]
        of_others = [KnownPair(there[0], there[1], None)] if len(there) == 2 else pairs
        pairs = [p for p in pairs if not {p.a, p.b} & late.keys()] or of_others
    if not pairs and len(drones) > 1:
        raise ConfigError(
            f"{recording.path}: no distance is known between two of {', '.join(names)}; "
            f"give --known-distance {names[0]}:{names[1]}=METRES"
        )
    return pairs


def known_distances(
    drones: Sequence[Drone],
    pairs: Sequence[KnownPair],
    late: Mapping[str, float],
    first_map_ns: int,
) -> list[tuple[str, str, float]]:
    """Return (drone, drone, metres) of each pair; where nobody gives metres, those of the truth.

    Args:
        drones: those that fly, with the frames that they fly.
        pairs: of them.
        late: whose daemons come in which second.
        first_map_ns: when the first map is made; of who is not there yet the distance is that of
            when it comes.

    Raises:
        ConfigError: the truth does not say one.
    """
    by_name = {drone.name: drone for drone in drones}
    starts_ns = min(drone.frames[0].at_ns for drone in drones)
    out = []
    for pair in pairs:
        both = by_name[pair.a], by_name[pair.b]
        distance_m = pair.distance_m
        if distance_m is None:
            come_ns = [drone.frames[0].at_ns for drone in both]
            come_ns += [starts_ns + round(late.get(drone.name, 0.0) * 1e9) for drone in both]
            distance_m = _true_distance_m(*both, max(first_map_ns, *come_ns))
        if distance_m is None:
            raise ConfigError(
                f"the truth does not say how far {pair.a} is from {pair.b} at the start; "
                f"give --known-distance {pair.a}:{pair.b}=METRES"
            )
        out.append((pair.a, pair.b, distance_m))
    return out


def _true_distance_m(a: Drone, b: Drone, at_ns: int) -> float | None:
    """Return how far two drones, both there, are apart at their newest frames of then, by truth."""
    starts = []
    for drone in (a, b):
        n_come = int(np.searchsorted(instants_of(drone), at_ns, side="right"))
        newest_ns = drone.frames[n_come - 1].at_ns
        start = drone.truth.pose_at(newest_ns) if drone.truth else None
        if start is None:
            return None
        starts.append(start.translation)
    distance_m = float(np.linalg.norm(starts[0] - starts[1]))
    return distance_m if distance_m > 0.0 else None
