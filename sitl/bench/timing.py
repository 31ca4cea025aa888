"""How long calls take, side by side: one thread, repetitions of all of them interleaved.

Processor time is measured, not the clock on the wall: what else the machine
does then hardly counts, and whoever uses two threads pays for both.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

# Calls shorter than this are repeated until they are not.
_LEAST_NS = 1_000_000


@dataclass(frozen=True)
class Accuracy:
    """What an answer is worth: in words, and whether it is right at all."""

    text: str
    right: bool


@dataclass(frozen=True, eq=False)
class Entry:
    """One way to do a step.

    Attributes:
        name: "ours", or begins with the name of the library.
        run: does it once; gives the same answer every time.
        judge: what the answer is worth.
    """

    name: str
    run: Callable[[], Any]
    judge: Callable[[Any], Accuracy]


@dataclass(frozen=True)
class Measured:
    """One way to do a step, measured.

    Attributes:
        step: name of the step.
        name: of the entry.
        median_ms, p95_ms: of one call.
        repetitions: how many were measured.
        ratio: median of this over that of the step's first entry.
        accuracy: of its answer.
    """

    step: str
    name: str
    median_ms: float
    p95_ms: float
    repetitions: int
    ratio: float
    accuracy: Accuracy


@dataclass(frozen=True)
class Effort:
    """How long to measure.

    Attributes:
        budget_s: for one step, all its entries together.
        least, most: repetitions.
    """

    budget_s: float
    least: int
    most: int


def measured(step: str, entries: Sequence[Entry], effort: Effort) -> list[Measured]:
    """Run all entries in turns and judge their answers."""
    accuracies, inner = [], []
    for entry in entries:
        # The first call compiles, loads and allocates; its answer is as good as any.
        accuracies.append(entry.judge(entry.run()))
        inner.append(1 + _LEAST_NS // max(_spent_ns(entry.run, 1), 1_000))
    times = interleaved([entry.run for entry in entries], effort, inner)
    first = float(np.median(times[0]))
    return [
        Measured(
            step,
            entry.name,
            float(np.median(mine)),
            float(np.quantile(mine, 0.95)),
            len(mine),
            float(np.median(mine)) / first,
            accuracy,
        )
        for entry, mine, accuracy in zip(entries, times, accuracies, strict=True)
    ]


def interleaved(
    runs: Sequence[Callable[[], Any]], effort: Effort, inner: Sequence[int] | None = None
) -> list[list[float]]:
    """Return the times of one call of each, ms, as often as there is time for all in turns.

    Args:
        runs: what is called.
        effort: how long, how often.
        inner: so many calls of each make one measurement; None: one.
    """
    calls = inner or [1] * len(runs)
    times: list[list[float]] = [[] for _ in runs]
    until = time.perf_counter() + effort.budget_s
    was_on = gc.isenabled()
    gc.disable()
    try:
        for done in range(effort.most):
            if done >= effort.least and time.perf_counter() > until:
                break
            for run, n, mine in zip(runs, calls, times, strict=True):
                mine.append(1e-6 * _spent_ns(run, n) / n)
    finally:
        if was_on:
            gc.enable()
    return times


def _spent_ns(run: Callable[[], Any], calls: int) -> int:
    started = time.process_time_ns()
    for _ in range(calls):
        run()
    return time.process_time_ns() - started
