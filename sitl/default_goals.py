"""What the default pipeline must show on the paper's worlds, one row each (issue 4)."""

from __future__ import annotations

import numpy as np

from sitl.goals import Flights, Goal, Verdict, cm, judged, not_flown, rmse_cm
from sitl.paper_estimates import nees_median
from sitl.paper_flights import PaperFlight
from sitl.paper_goals import never_worse, rotate
from sitl.paper_measures import after_first_map, end_of

_BACK_CM = {"forward_back": 4.0, "forward_back_near": 4.0, "forward_back_noisy": 6.0}
_SPARSE_CM = 15.0
_DRIFT_SHARE = 0.005
NEES_MEDIAN = (3.0, 10.0)
_WITHIN_SHARE = 0.95


def default_goals(flights: Flights, *, whole: bool) -> list[Goal]:
    """Return every row.

    Args:
        flights: what was flown by the default pipeline.
        whole: False when the recordings were cut short: then nothing is judged.
    """
    rows = [
        *rotate(flights.get(("rotate", True))),
        _sparse(flights.get(("sparse", True))),
        *(_back(name, flights.get((name, True))) for name in _BACK_CM),
        never_worse(flights),
        *_urban(flights.get(("urban", True))),
        *_true(flights),
    ]
    return judged(rows, whole)


def _back(name: str, flight: PaperFlight | None) -> Goal:
    what, asked = "3-D RMSE of every drone", f"≤ {_BACK_CM[name]:.0f} cm each"
    if flight is None:
        return not_flown(name, what, asked)
    errors = {drone.name: rmse_cm(flight, drone.name) for drone in flight.result.drones}
    fine = all(error is not None and error <= _BACK_CM[name] for error in errors.values())
    told = ", ".join(f"{drone} {cm(error)}" for drone, error in errors.items())
    return Goal(name, what, asked, told, "met" if fine else "not met")


def _sparse(flight: PaperFlight | None) -> Goal:
    what = "the targets that see little"
    asked = f"every frame answered, 3-D RMSE ≤ {_SPARSE_CM:.0f} cm"
    if flight is None:
        return not_flown("sparse", what, asked)
    fine, told = True, []
    for name in flight.experiment.targets:
        drone, error = flight.drone(name), rmse_cm(flight, name)
        fine = fine and error is not None and error <= _SPARSE_CM and not drone.unaccounted
        fine = fine and drone.n_localized + drone.log.count("refused") == drone.n_frames
        share = drone.n_localized / drone.n_frames
        told.append(f"{name} {cm(error)}, {100 * share:.0f} % localized")
    return Goal("sparse", what, asked, "; ".join(told), "met" if fine else "not met")


def _urban(flight: PaperFlight | None) -> list[Goal]:
    what = "every frame after the first map localized", "final drift"
    asked = "all", f"≤ {100 * _DRIFT_SHARE:.1f} % of the way"
    if flight is None:
        return [not_flown("urban", w, g) for w, g in zip(what, asked, strict=True)]
    told, drifts, all_seen, near = [], [], True, True
    for drone in flight.result.drones:
        after = after_first_map(drone, {row.sequence: row for row in drone.log.frames})
        end = end_of(drone)
        if after is None or end is None:
            all_seen = near = False
            told.append(f"{drone.name} never localized")
            continue
        all_seen = all_seen and after["localized"] == after["frames"]
        told.append(f"{drone.name} {after['localized']} of {after['frames']}")
        share = end["drift_m"] / max(end["way_m"], 1e-9)
        near = near and share <= _DRIFT_SHARE and end["before_end_s"] < 1.0
        drifts.append(
            f"{drone.name} {100 * end['drift_m']:.0f} cm after {end['way_m']:.0f} m "
            f"({100 * share:.2f} %)"
        )
    return [
        Goal("urban", what[0], asked[0], ", ".join(told), "met" if all_seen else "not met"),
        Goal("urban", what[1], asked[1], ", ".join(drifts), "met" if near else "not met"),
    ]


def _true(flights: Flights) -> list[Goal]:
    """Return whether what is sent errs as much as it says, scene by scene."""
    low, high = NEES_MEDIAN
    out = []
    for (name, fused), flight in flights.items():
        if not fused:
            continue
        asked = f"NEES median {low:.0f} to {high:.0f}, {100 * _WITHIN_SHARE:.0f} % within 3 sigma"
        # The alignment takes the leader's first pose for exact, and with it what its errors share.
        others = [d for d in flight.result.drones if d.name != flight.result.plan.leader]
        sent = [d.errors for d in others if d.errors is not None]
        if not sent:
            out.append(Goal(name, "poses as true as they say", asked, "none sent", "not met"))
            continue
        median = nees_median(np.concatenate([errors.nees for errors in sent]))
        shares = [flight.report["drones"][d.name]["within_3_sigma_share"] for d in others]
        least = min((share for share in shares if share is not None), default=0.0)
        fine = median is not None and low <= median <= high and least >= _WITHIN_SHARE
        told = f"{median:.1f}" if median is not None else "unknown"
        measured = f"{told}; {100 * least:.0f} % within 3 sigma, of the drone with fewest"
        verdict: Verdict = "met" if fine else "not met"
        out.append(Goal(name, "poses as true as they say", asked, measured, verdict))
    return out
