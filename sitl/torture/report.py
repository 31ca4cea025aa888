"""What a run comes to: ``report.json``, and what the terminal shows of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from sitl.bench.machine import machine
from sitl.report import rounded
from sitl.torture.session import SessionResult
from vcl_companion.errors import ConfigError

_MIB = 1 << 20
# Kept by a process after any session, more than after its first: what that took it may have.
MOST_GROWTH_BYTES = 32 * _MIB
_MOST_SHOWN = 12


@dataclass(frozen=True)
class TortureOptions:
    """What is asked for.

    Attributes:
        payloads: how many, in all.
        seed: of all of them.
        processes: that share the work; 0 for one per core.
        session: payloads that one drone lives through before the next begins anew.
    """

    payloads: int = 600_000
    seed: int = 0
    processes: int = 0
    session: int = 20_000

    def __post_init__(self) -> None:
        if self.payloads < 1 or self.session < 1:
            raise ConfigError("--payloads and --session must be positive")
        if self.processes < 0 or self.seed < 0:
            raise ConfigError("--processes and --seed must not be negative")


def report_of(
    options: TortureOptions, results: list[SessionResult], wall_s: float
) -> dict[str, Any]:
    """Return what sessions come to, as JSON knows it."""
    outcomes: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    first: dict[str, int] = {}
    for result in results:
        outcomes.update(result.outcomes)
        for failure in result.failures:
            kinds[failure.what] += 1
            first.setdefault(failure.what, failure.index)
    payloads = sum(result.payloads for result in results)
    growth = grown_bytes(results)
    report = {
        "machine": machine(),
        "payloads": payloads,
        "seed": options.seed,
        "session": options.session,
        "processes": len({result.pid for result in results}),
        "wall_s": wall_s,
        "payloads_per_s": payloads / wall_s if wall_s > 0 else None,
        "payloads_per_cpu_s": payloads / max(sum(r.seconds for r in results), 1e-9),
        "failures": sum(result.n_failures for result in results),
        "failures_by_kind": [
            {"what": what, "times": times, "first_index": first[what]}
            for what, times in kinds.most_common()
        ],
        "memory": {
            "grown_mib": None if growth is None else growth / _MIB,
            "most_grown_mib": MOST_GROWTH_BYTES / _MIB,
            "most_resident_mib": max(r.resident_bytes for r in results) / _MIB,
            "bounded": growth is None or growth <= MOST_GROWTH_BYTES,
        },
        "outcomes": dict(outcomes.most_common()),
    }
    checked = rounded(report)
    assert isinstance(checked, dict)
    return checked


def grown_bytes(results: list[SessionResult]) -> int | None:
    """Return how much more memory a process kept after a session than after its first one.

    The most of all processes; None when none has had a second one.
    """
    by_process: dict[int, list[SessionResult]] = {}
    for result in sorted(results, key=lambda r: r.turn):
        by_process.setdefault(result.pid, []).append(result)
    grown = [
        max(later.kept_bytes for later in rest) - first.kept_bytes
        for first, *rest in by_process.values()
        if rest
    ]
    return max(grown, default=None)


def is_good(report: dict[str, Any]) -> bool:
    """Whether nothing failed and memory stayed within its bound."""
    return bool(report["failures"] == 0 and report["memory"]["bounded"])


def show_torture(console: Console, report: dict[str, Any], out: Path) -> None:
    """Print what a run comes to, what failed and how to have it again."""

    def line(text: str) -> None:
        console.print(text, markup=False, highlight=False, soft_wrap=True)

    for outcome, times in list(report["outcomes"].items())[:_MOST_SHOWN]:
        line(f"{times:>10}  {outcome}")
    line(f"{len(report['outcomes']):>10}  outcomes in all, see report.json")
    rate = max(report["payloads_per_s"], 1.0)  # of none where nothing was gone through
    line(
        f"{report['payloads']} payloads in {report['wall_s']:.0f} s, {rate:.0f} a second by "
        f"{report['processes']} process(es); 10 million take {1e7 / rate / 60:.0f} minutes"
    )
    memory = report["memory"]
    grown = memory["grown_mib"]
    line(
        "memory: not judged, no process had a second session"
        if grown is None
        else f"memory: {grown:.1f} MiB more kept than after the first session, "
        f"at most {memory['most_grown_mib']:.0f} allowed"
        f"{'' if memory['bounded'] else ': TOO MUCH'}"
    )
    again = f"python -m sitl torture --seed {report['seed']} --session {report['session']} --only"
    for kind in report["failures_by_kind"]:
        line(f"FAILED {kind['times']} times: {kind['what']}")
        line(f"  again: {again} {kind['first_index']}")
    if not report["failures"]:
        line("nothing failed")
    line(f"report: {out / 'report.json'}")
