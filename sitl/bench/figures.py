"""A measured number, what it has to be, and how numbers grow with what they depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Figure:
    """A measured number.

    Attributes:
        name: of what.
        value: in ``unit``.
        unit: ms, s, MB, %, ...
        goal: what it may be at most; None: it is only told.
        at_least: the goal is what it has to be at least.
        note: how it came about.
    """

    name: str
    value: float
    unit: str
    goal: float | None = None
    at_least: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether the goal is reached; None without one."""
        if self.goal is None:
            return None
        return self.value >= self.goal if self.at_least else self.value <= self.goal


@dataclass(frozen=True)
class Growth:
    """A cost at several sizes.

    Attributes:
        of: what is measured.
        unit: of the costs.
        sizes: what it depends on.
        costs: one for each size.
    """

    of: str
    unit: str
    sizes: tuple[float, ...]
    costs: tuple[float, ...]

    @property
    def exponent(self) -> float:
        """Exponent b of the power law a size^b through the costs, by least squares of logarithms.

        NaN for one size.
        """
        if len(self.sizes) < 2:
            return float("nan")
        slope, _ = np.polyfit(np.log(self.sizes), np.log(np.maximum(self.costs, 1e-9)), 1)
        return float(slope)


def median_and_p95(
    name: str, times_ms: Sequence[float], goals: tuple[float | None, float | None], note: str = ""
) -> list[Figure]:
    """Return median and 95th percentile of times, with their goals."""
    return [
        Figure(f"{name}, median", float(np.median(times_ms)), "ms", goals[0], note=note),
        Figure(f"{name}, p95", float(np.quantile(times_ms, 0.95)), "ms", goals[1]),
    ]
