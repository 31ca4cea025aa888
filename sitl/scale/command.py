"""``python -m sitl scale``: one number of drones after the other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from sitl.result_folder import result_folder
from sitl.scale.report import report_of, show_scale, write_scale
from sitl.scale.swarm import ScaleTimes, SwarmResult, Told, run_swarm
from vcl_companion.errors import ConfigError

_FEWEST, _MOST = 2, 250


@dataclass(frozen=True)
class ScaleOptions:
    """What is asked for.

    Attributes:
        drones: how many there are, in one run after the other.
        loss: share of the datagrams that each receiver loses.
        seed: of what is lost, of clocks, and of the map.
        times: for how long things are measured.
    """

    drones: tuple[int, ...] = (2, 5, 10, 30, 100)
    loss: float = 0.1
    seed: int = 0
    times: ScaleTimes = field(default_factory=ScaleTimes)

    def __post_init__(self) -> None:
        if not self.drones or len(set(self.drones)) != len(self.drones):
            raise ConfigError("--drones: give different numbers, like 2,5,10")
        for n_drones in self.drones:
            if not _FEWEST <= n_drones <= _MOST:
                raise ConfigError(f"--drones: {n_drones} is not {_FEWEST} to {_MOST}")
        if not 0.0 <= self.loss < 1.0:
            raise ConfigError(f"--loss must be a share of 0 to below 1, got {self.loss}")
        if self.seed < 0:
            raise ConfigError(f"--seed must not be negative, got {self.seed}")


def parse_drones(text: str) -> tuple[int, ...]:
    """Read ``--drones``.

    Raises:
        ConfigError: it is no list of whole numbers.
    """
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError:
        raise ConfigError(f"--drones: {text!r} is no list of numbers like 2,5,10") from None


def scale(out: Path, options: ScaleOptions, told: Told) -> dict[str, Any]:
    """Measure, and write ``scale.json``, ``scale.md`` and ``scale.svg`` into a folder.

    Args:
        out: made if absent.
        options: what to measure.
        told: what is measured now.

    Returns:
        The report.

    Raises:
        ConfigError: the folder is another one's, or cannot be written.
    """
    with result_folder(out, ("scale.*",)):
        results = [_swarm(n_drones, options, told) for n_drones in sorted(options.drones)]
        report = report_of(results, options.loss, options.seed)
        write_scale(out, report)
    return report


def _swarm(n_drones: int, options: ScaleOptions, told: Told) -> SwarmResult:
    return run_swarm(
        n_drones,
        options.loss,
        options.seed,
        options.times,
        lambda phase: told(f"{n_drones} drones: {phase}"),
    )


def run_scale(out: Path, options: ScaleOptions, console: Console) -> None:
    """Measure and show it all.

    Raises:
        ConfigError: the folder cannot be written.
    """
    report = scale(out, options, lambda what: console.out(what, highlight=False))
    show_scale(console, report, out)
