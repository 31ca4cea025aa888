"""When a drone's daemon is not there, late or killed in flight, and when its camera is dead."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from vcl_companion.errors import ConfigError

_LATE_LIKE = "like mav2=8 (its daemon is started at second 8)"
_KILL_LIKE = "like mav0=12 (killed at second 12), or mav0=12-20 (and started again at second 20)"
_BLIND_LIKE = "like mav0=12 (dead from second 12 on), or mav0=12-20 (until second 20)"
_WHEN = re.compile(r"([0-9.]+)(?:-([0-9.]+))?")


@dataclass(frozen=True)
class Absence:
    """A time in which the daemon of a drone does not run; its autopilot and its camera go on.

    Attributes:
        drone: ``mavN``.
        from_s: when it is killed; a flight's seconds count from its first frame. 0: it was
            not there from the start.
        until_s: when it is started; infinite for never.
    """

    drone: str
    from_s: float
    until_s: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.from_s < self.until_s:
            raise ConfigError(f"{self}: must be started after it is killed, {_KILL_LIKE}")

    @property
    def is_late(self) -> bool:
        """Whether the daemon is not there from the start, but comes later."""
        return self.from_s == 0.0

    def __str__(self) -> str:
        """Return the option that says so."""
        if self.is_late:
            return f"--late {self.drone}={self.until_s:g}"
        until = "" if math.isinf(self.until_s) else f"-{self.until_s:g}"
        return f"--kill {self.drone}={self.from_s:g}{until}"


@dataclass(frozen=True)
class Blindness:
    """A time in which the camera of a drone gives no frames; its daemon and its autopilot go on.

    Attributes:
        drone: ``mavN``.
        from_s: frames from this second on are not given; a flight's count from its first frame.
        until_s: from this one on they are again; infinite for never.
    """

    drone: str
    from_s: float
    until_s: float

    def __post_init__(self) -> None:
        if not 0.0 < self.from_s < self.until_s:
            raise ConfigError(f"{self}: must end after it has begun, {_BLIND_LIKE}")

    def __str__(self) -> str:
        """Return the option that says so."""
        until = "" if math.isinf(self.until_s) else f"-{self.until_s:g}"
        return f"--blind {self.drone}={self.from_s:g}{until}"

    def has(self, drone: str, at_s: float) -> bool:
        """Return whether a drone's frame of that second is not given."""
        return drone == self.drone and self.from_s <= at_s < self.until_s


def seconds_late(absences: Sequence[Absence]) -> dict[str, float]:
    """Return which drones' daemons come later than the start, and in which second."""
    return {absence.drone: absence.until_s for absence in absences if absence.is_late}


def parse_late(text: str) -> Absence:
    """Return what ``mav2=8`` says.

    Raises:
        ConfigError: it has another form.
    """
    drone, at_s, until_s = _drone_and_times(text)
    if not drone or not 0.0 < at_s < math.inf or until_s is not None:
        raise ConfigError(f"--late {text}: expected DRONE=SECOND above 0, {_LATE_LIKE}")
    return Absence(drone, 0.0, at_s)


def parse_kill(text: str) -> Absence:
    """Return what ``mav0=12`` or ``mav0=12-20`` says.

    Raises:
        ConfigError: it has another form.
    """
    return Absence(*_from_until("--kill", text, _KILL_LIKE))


def parse_blind(text: str) -> Blindness:
    """Return what ``mav0=12`` or ``mav0=12-20`` says.

    Raises:
        ConfigError: it has another form.
    """
    return Blindness(*_from_until("--blind", text, _BLIND_LIKE))


def check_times(
    times: Sequence[Absence | Blindness], names: Sequence[str], duration_s: float
) -> None:
    """Raise ConfigError when what happens to a drone does not go with a flight.

    Args:
        times: all of them.
        names: who flies.
        duration_s: of the flight.
    """
    for time in times:
        if time.drone not in names:
            raise ConfigError(f"{time}: {time.drone!r} does not fly ({', '.join(names)})")
        last_s = time.from_s if math.isinf(time.until_s) else time.until_s
        if last_s >= duration_s:
            raise ConfigError(f"{time}: the flight is over after {duration_s:.1f} s")
    for one, next_one in itertools.pairwise(sorted(times, key=lambda t: (t.drone, t.from_s))):
        if one.drone == next_one.drone and next_one.from_s <= one.until_s:
            does = "runs" if isinstance(next_one, Absence) else "sees anything"
            raise ConfigError(f"{next_one}: no longer {does} then, by {one}")


def check_absences(absences: Sequence[Absence], names: Sequence[str], duration_s: float) -> None:
    """Raise ConfigError when absences do not go together, or not with a flight.

    Args:
        absences: all of them.
        names: who flies.
        duration_s: of the flight.
    """
    check_times(absences, names, duration_s)
    if seconds_late(absences).keys() >= set(names):
        raise ConfigError("--late: nobody is there from the start")


def _from_until(option: str, text: str, like: str) -> tuple[str, float, float]:
    drone, at_s, until_s = _drone_and_times(text)
    if not drone or not 0.0 < at_s < math.inf:
        raise ConfigError(f"{option} {text}: expected DRONE=SECOND above 0, {like}")
    return drone, at_s, math.inf if until_s is None else until_s


def _drone_and_times(text: str) -> tuple[str, float, float | None]:
    """Return name and seconds; NaN for what is none."""
    drone, _, when = text.partition("=")
    found = _WHEN.fullmatch(when.strip())
    try:
        if found:
            until_s = None if found[2] is None else float(found[2])
            return drone.strip(), float(found[1]), until_s
    except ValueError:
        pass
    return drone.strip(), math.nan, None
