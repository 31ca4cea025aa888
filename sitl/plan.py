"""What a flight will be: who flies, who leads, which distances are known, who says the attitude."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sitl.absences import Absence, Blindness, check_absences, check_times, seconds_late
from sitl.firmware import FirmwareBinary
from sitl.first_map import beginning, instants_of, n_before
from sitl.known_distances import known_distances, known_pairs
from sitl.mission import Mission
from sitl.network import NetworkOptions
from sitl.partitions import check_partitions
from vcl_companion.config import Config
from vcl_companion.errors import ConfigError
from vcl_companion.recording import Drone, KnownPair, Recording
from vcl_companion.recording.sensor import nominal_rate_hz

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
# Whose frames come so many times as fast as its camera's are not stamped in nanoseconds.
_MOST_TIMES_RATE = 100.0


@dataclass(frozen=True)
class Setting:
    """One key of the daemon's configuration, given by hand.

    Attributes:
        path: sections and key.
        value: what TOML made of the text.
    """

    path: tuple[str, ...]
    value: object


@dataclass(frozen=True)
class FlyOptions:
    """How a recording is flown.

    Attributes:
        speed: recording seconds per wall second; infinite: as fast as all daemons keep up, their
            maps included.
        attitude: output folder of an earlier flight whose attitude streams are sent again.
        known_distances: instead of the recording's; a pair without metres is taken
            from the truth when the first map is made.
        drones: names of those that fly; empty: all.
        start_timeout_s: how long the daemons have to come up, and again to make the first map.
        settings: more of the daemons' configuration.
        seed: of the noise of the attitude, and of the network.
        network: how bad the radio between the drones is.
        absences: when whose daemon does not run.
        blind: when whose camera gives nothing.
        firmware: real autopilot software in the stand-ins' place; None: stand-ins.
    """

    speed: float = 1.0
    attitude: Path | None = None
    known_distances: tuple[KnownPair, ...] = ()
    drones: tuple[str, ...] = ()
    start_timeout_s: float = 30.0
    settings: tuple[Setting, ...] = ()
    seed: int = 0
    network: NetworkOptions = field(default_factory=NetworkOptions)
    absences: tuple[Absence, ...] = ()
    blind: tuple[Blindness, ...] = ()
    firmware: FirmwareBinary | None = None

    def __post_init__(self) -> None:
        if not self.speed > 0.0:
            raise ConfigError(f"--speed must be positive or max, got {self.speed}")
        if not 0.0 < self.start_timeout_s < math.inf:
            raise ConfigError(f"--start-timeout must be positive, got {self.start_timeout_s}")
        if self.seed < 0:
            raise ConfigError(f"--seed must not be negative, got {self.seed}")
        if self.firmware and self.attitude:
            raise ConfigError("--attitude: a real --autopilot has an attitude of its own")


@dataclass(frozen=True, eq=False)
class PlannedDrone:
    """One drone of a flight.

    Attributes:
        drone: what it recorded, of which it flies all frames.
        system_id: its MAVLink system id.
        attitude_path: attitude stream that is sent again; None: made from the truth.
        mission: what it does by itself in a live flight; None in a recorded one.
        n_left_out: how many frames it recorded before these, that no first map could be made of.
    """

    drone: Drone
    system_id: int
    attitude_path: Path | None
    mission: Mission | None = None
    n_left_out: int = 0

    @property
    def name(self) -> str:
        """``mavN``."""
        return self.drone.name

    @property
    def frames_at_ns(self) -> NDArray[np.int64]:
        """(F,) instants of its frames."""
        return instants_of(self.drone)


@dataclass(frozen=True, eq=False)
class FlightPlan:
    """A flight, ready to start.

    Attributes:
        recording: where the images come from.
        drones: those that fly, in the recording's order.
        leader: name of the one whose start is the origin.
        known_distances: (system id, system id, m).
        options: how it is flown.
        waited_for: names of those whose first frame the recording waits with for the first map.
    """

    recording: Recording
    drones: tuple[PlannedDrone, ...]
    leader: str
    known_distances: tuple[tuple[int, int, float], ...]
    options: FlyOptions
    waited_for: frozenset[str]

    @property
    def are_distances_recorded(self) -> bool:
        """Whether no option gives metres: all distances are the recording's or its truth's."""
        return all(pair.distance_m is None for pair in self.options.known_distances)

    @property
    def starts_at_ns(self) -> int:
        """The first frame's instant; times in a report count from it."""
        return min(int(drone.frames_at_ns[0]) for drone in self.drones)

    @property
    def ends_at_ns(self) -> int:
        """The last frame's instant."""
        return max(int(drone.frames_at_ns[-1]) for drone in self.drones)

    def system_id(self, name: str) -> int:
        """Return a drone's MAVLink system id."""
        return next(drone.system_id for drone in self.drones if drone.name == name)


def parse_setting(text: str) -> Setting:
    """Return the setting that ``section.key=value`` says, the value in TOML's notation.

    Raises:
        ConfigError: it has another form.
    """
    name, equals, value = text.partition("=")
    path = tuple(part.strip() for part in name.split("."))
    if not equals or not all(_BARE_KEY.fullmatch(part) for part in path):
        raise ConfigError(f"--set {text}: expected section.key=value")
    try:
        table = tomllib.loads(f"value = {value}")
    except (tomllib.TOMLDecodeError, RecursionError):
        table = {}
    if list(table) != ["value"]:
        raise ConfigError(f"--set {text}: {value!r} is no TOML value (a string needs quotes)")
    return Setting(path, table["value"])


def pipeline_setting(name: str) -> Setting:
    """Return the setting that has daemons find their poses so: ``default`` or ``paper``."""
    return Setting(("pipeline",), name)


def pipeline_of(settings: Sequence[Setting]) -> object:
    """Return which pipeline settings ask for: the last of them, else the daemons' own default."""
    asked = [setting.value for setting in settings if setting.path == ("pipeline",)]
    return asked[-1] if asked else Config().pipeline


def plan_flight(recording: Recording, options: FlyOptions) -> FlightPlan:
    """Decide who flies and with what.

    Raises:
        ConfigError: an option does not fit the recording; one line, says what would.
    """
    names = [drone.name for drone in recording.drones]
    for name in options.drones:
        if name not in names:
            raise ConfigError(f"--drones: {recording.path} has no {name!r} ({', '.join(names)})")
        if options.drones.count(name) > 1:
            raise ConfigError(f"--drones: {name} is given twice")
    flying = [name for name in names if not options.drones or name in options.drones]
    recorded = [drone for drone in recording.drones if drone.name in flying]
    attitudes = {drone.name: _attitude_path(drone, options) for drone in recorded}
    for drone in recorded:
        _check_instants(drone)
    late = seconds_late(options.absences)
    pairs = known_pairs(recording, recorded, options.known_distances, late)
    leader = recording.leader if recording.leader in flying else flying[0]
    # That nobody is there is said below, where it is known how long the flight is.
    there = [drone for drone in recorded if drone.name not in late] or recorded
    begins = beginning(there, leader, pairs)
    left_out = {d.name: n_before(d, begins, is_late=d.name in late) for d in recorded}
    flown = [replace(drone, frames=drone.frames[left_out[drone.name] :]) for drone in recorded]
    ids = {name: n + 1 for n, name in enumerate(names)}
    plan = FlightPlan(
        recording=recording,
        drones=tuple(
            PlannedDrone(d, ids[d.name], attitudes[d.name], n_left_out=left_out[d.name])
            for d in flown
        ),
        leader=leader,
        known_distances=tuple(
            (ids[a], ids[b], distance_m)
            for a, b, distance_m in known_distances(flown, pairs, late, begins.at_ns)
        ),
        options=options,
        waited_for=begins.drones,
    )
    duration_s = (plan.ends_at_ns - plan.starts_at_ns) * 1e-9
    check_partitions(options.network.partitions, flying, duration_s)
    check_absences(options.absences, flying, duration_s)
    check_times(options.blind, flying, duration_s)
    return plan


def _attitude_path(drone: Drone, options: FlyOptions) -> Path | None:
    earlier = options.attitude
    if earlier is not None:
        path = earlier / drone.name / "attitude.csv"
        if not path.is_file():
            raise ConfigError(f"--attitude {earlier}: no {drone.name}/attitude.csv in it")
        return path.resolve()
    if drone.truth is None:
        if options.firmware:
            raise ConfigError(f"--autopilot: {drone.name} has no ground truth to move it along")
        raise ConfigError(
            f"{drone.name} has no ground truth to make the autopilot's attitude of; "
            "give --attitude DIR, the --out of an earlier flight"
        )
    return None


def _check_instants(drone: Drone) -> None:
    """Refuse a truth of another time, and instants that are no nanoseconds."""
    at_ns = instants_of(drone)
    if drone.truth is not None and not any(drone.truth.pose_at(int(t)) for t in at_ns):
        raise ConfigError(
            f"{drone.name}: frames from {at_ns[0]} to {at_ns[-1]} ns, and no ground truth of any: "
            "are both stamped by one clock?"
        )
    rate_hz = nominal_rate_hz(at_ns.tolist())
    if rate_hz > _MOST_TIMES_RATE * drone.sensor.rate_hz:
        raise ConfigError(
            f"{drone.name}: {rate_hz:g} frames a second by their instants, "
            f"{drone.sensor.rate_hz:g} by its sensor.yaml: instants are nanoseconds"
        )
