"""When a swarm falls apart: who cannot hear whom, from when to when."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from vcl_companion.errors import ConfigError

_SPAN = re.compile(r"\s*([0-9.]+)\s*-\s*([0-9.]+)\s*")
_LIKE = "like 10-40:mav0|mav1,mav2 (from second 10 until 40)"


@dataclass(frozen=True)
class Partition:
    """A time in which drones of different groups do not hear each other.

    Attributes:
        from_s: when it begins; a flight's seconds count from its first frame.
        until_s: when they hear each other again.
        groups: two or more; whoever is in none of them hears and is heard by everybody.
    """

    from_s: float
    until_s: float
    groups: tuple[frozenset[str], ...]

    def __post_init__(self) -> None:
        if not 0.0 <= self.from_s < self.until_s < math.inf:
            raise ConfigError(f"--partition {self}: must end after it begins, {_LIKE}")
        if len(self.groups) < 2 or not all(self.groups):
            raise ConfigError(f"--partition {self}: needs two groups or more, {_LIKE}")
        if sum(map(len, self.groups)) > len(self.names):
            raise ConfigError(f"--partition {self}: a drone is in one group only, {_LIKE}")

    def __str__(self) -> str:
        groups = "|".join(",".join(sorted(group)) for group in self.groups)
        return f"{self.from_s:g}-{self.until_s:g}:{groups}"

    @property
    def names(self) -> frozenset[str]:
        """Everybody in one of its groups."""
        return frozenset().union(*self.groups)

    def cuts(self, at_s: float, sender: str, receiver: str) -> bool:
        """Return whether one cannot be heard by another at an instant."""
        if not self.from_s <= at_s < self.until_s:
            return False
        theirs = [group for group in self.groups if sender in group or receiver in group]
        return len(theirs) == 2


def parse_partition(text: str) -> Partition:
    """Return what ``10-40:mav0|mav1,mav2`` says.

    Raises:
        ConfigError: it has another form.
    """
    times, colon, groups = text.partition(":")
    span = _SPAN.fullmatch(times)
    try:
        if colon and span:
            return Partition(float(span[1]), float(span[2]), tuple(map(_group, groups.split("|"))))
    except ValueError:
        pass
    raise ConfigError(f"--partition {text}: expected FROM-UNTIL:GROUP|GROUP, {_LIKE}")


def check_partitions(
    partitions: Sequence[Partition], names: Sequence[str], duration_s: float
) -> None:
    """Raise ConfigError when a partition names who does not fly, or begins after the flight.

    Args:
        partitions: all of them.
        names: who flies.
        duration_s: of the flight.
    """
    for partition in partitions:
        for name in sorted(partition.names - set(names)):
            raise ConfigError(f"--partition: {name!r} does not fly ({', '.join(names)})")
        if partition.from_s >= duration_s:
            raise ConfigError(
                f"--partition {partition}: the flight is over after {duration_s:.1f} s"
            )


def _group(text: str) -> frozenset[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names) or len(set(names)) != len(names):
        raise ValueError(text)
    return frozenset(names)
