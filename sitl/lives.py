"""How long each drone's daemon lived and which frames it was given, kept beside the logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from sitl.flight_log import FlightLog, joined, read_flight_log
from sitl.processes import FlightError

_FILE = Path("run") / "lives.json"


@dataclass
class Life:
    """One run of a daemon, in the recording's time.

    Attributes:
        started_at_ns: when its process was started.
        ready_at_ns: when it had connected to its camera, which is when it also begins to
            speak to autopilot and peers; None if it did not.
        killed_at_ns: when it was killed; None if it was there to the end.
    """

    started_at_ns: int
    ready_at_ns: int | None = None
    killed_at_ns: int | None = None


@dataclass
class Lives:
    """All runs of one drone's daemon.

    Attributes:
        lives: in order; several when it was killed and started again.
        frames: sequence of each frame that a run was given; not those that it had in hand
            when it was killed.
    """

    lives: list[Life] = field(default_factory=list)
    frames: Sequence[int] = ()


def write_lives(out: Path, lives: Mapping[str, Lives]) -> None:
    """Write every drone's into a flight's folder."""
    (out / _FILE).write_bytes(msgspec.json.encode(lives) + b"\n")


def read_lives(out: Path) -> dict[str, Lives]:
    """Read what was written, by drone; empty when there is nothing.

    Raises:
        FlightError: it is not what it should be; names the file.
    """
    path = out / _FILE
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Lives])
    except FileNotFoundError:
        return {}
    except (OSError, msgspec.MsgspecError) as error:
        raise FlightError(f"{path}: {error}") from error


def read_log(run: Path, lives: Lives | None) -> FlightLog:
    """Read what a drone's daemon has logged in all of its lives, of the frames that count.

    Args:
        run: the drone's folder.
        lives: its daemon's; None for one life over the whole flight.

    Raises:
        FlightError: a file is missing or broken; names it.
    """
    if lives is None:
        return read_flight_log(run / "flight.jsonl")
    logs = []
    for n, life in enumerate(lives.lives):
        if life.killed_at_ns is None:
            logs.append(read_flight_log(run / "flight.jsonl"))
        elif life.ready_at_ns is not None:
            logs.append(_of_frames(lives.frames, read_flight_log(log_path(run, n), cut_off=True)))
    return joined(logs)


def _of_frames(sequences: Sequence[int], log: FlightLog) -> FlightLog:
    """Leave out what was in hand when a daemon was killed: its camera was told nothing of it."""
    given = set(sequences)
    return replace(log, frames=tuple(f for f in log.frames if f.sequence in given), summary=None)


def log_path(run: Path, n: int) -> Path:
    """Return where the log of a daemon's n-th run, from 0, is kept after it was killed."""
    return run / f"flight-killed-{n}.jsonl"
