"""What a drone knew before it fused: its own fixes and its peers' proposals, against the truth.

Of each frame with a fix of its own, and of each proposal that came, the daemon's
``flight.jsonl`` has a line of the kind ``estimate``. Flights of daemons that do
not write them have none; then there is nothing to compare.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sitl.evaluation import PoseErrors, pose_errors
from sitl.flight_log import EstimateRow, estimates_of
from sitl.result import DroneResult, FlightResult
from vcl_companion.geometry.rotation import Array

Source = Literal["intra", "inter"]


@dataclass(frozen=True, eq=False)
class SourceEstimates:
    """One drone's estimates by source, those whose frame has a truth.

    Attributes:
        errors: T estimates against the truth.
        sources: (T,) ``intra`` or ``inter``.
        hosts: (T,) name of the drone that proposed it; empty for intra.
        fused: (T,) whether it went into the filter.
    """

    errors: PoseErrors
    sources: NDArray[np.str_]
    hosts: NDArray[np.str_]
    fused: NDArray[np.bool_]

    def of(self, source: Source, *, fused: bool | None = True) -> NDArray[np.bool_]:
        """Return (T,) which are of a source, and fused, refused, or (None) either."""
        mine = self.sources == source
        return np.asarray(mine if fused is None else mine & (self.fused == fused))

    def by_host(self) -> list[str]:
        """Return the drones that proposed something, in the order of their names."""
        return sorted(set(self.hosts.tolist()) - {""})

    def surest_host(self) -> tuple[NDArray[np.int64], list[str]]:
        """Return at each instant with proposals that went in: it, and the host with least sigma.

        The sigma is the heading's, as the proposal states it.
        """
        best: dict[int, tuple[float, str]] = {}
        for t in np.flatnonzero(self.of("inter")).tolist():
            sigma, at_ns = float(self.errors.yaw_sigma_rad[t]), int(self.errors.at_ns[t])
            if at_ns not in best or sigma < best[at_ns][0]:
                best[at_ns] = (sigma, str(self.hosts[t]))
        instants = sorted(best)
        return np.array(instants, dtype=np.int64), [best[at_ns][1] for at_ns in instants]


def by_source(flight: FlightResult, drone: DroneResult) -> SourceEstimates | None:
    """Return a drone's estimates by source; None when its log has none, or there is no truth.

    Args:
        flight: the whole flight, for the alignment and the drones' names.
        drone: whose.

    Raises:
        FlightError: an estimate in the log is no pose.
    """
    rows: Sequence[EstimateRow] = drone.log.estimates
    if flight.ref_from_world is None or not rows:
        return None
    names = {planned.system_id: planned.name for planned in flight.plan.drones}
    truth = dict(zip(drone.frames_at_ns.tolist(), drone.truth, strict=True))
    rows = [row for row in rows if truth.get(row.captured_at_ns) is not None]
    estimates = estimates_of(rows)
    true = tuple(truth[row.captured_at_ns] for row in rows)
    return SourceEstimates(
        errors=pose_errors(estimates, true, flight.ref_from_world),
        sources=np.array([row.source for row in rows], dtype=np.str_),
        hosts=np.array([_host(row, names) for row in rows], dtype=np.str_),
        fused=np.array([row.fused for row in rows], dtype=bool),
    )


def nees_median(nees: Array) -> float | None:
    """Return the median of what is known; None when nothing is."""
    known = nees[np.isfinite(nees)]
    return float(np.median(known)) if len(known) else None


def _host(row: EstimateRow, names: dict[int, str]) -> str:
    if row.source == "intra" or row.host is None:
        return ""
    return names.get(row.host, f"drone {row.host}")
