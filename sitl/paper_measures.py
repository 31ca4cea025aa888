"""The flights in numbers, as ``paper.json`` keeps them: per drone, and fused against unfused.

All errors are what the autopilots received minus the truth, along the axes of
the recording, after the one alignment of ``sitl.evaluation``. RMSE is over all
frames with a pose; a comparison is over the frames that both flights localized,
because a flight that refuses the hard frames would win otherwise.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sitl.evaluation import PoseErrors, position_rms_m
from sitl.paper_estimates import SourceEstimates, nees_median
from sitl.paper_flights import PaperFlight
from sitl.result import DroneResult
from vcl_companion.geometry.rotation import Array


def flight_measures(flight: PaperFlight) -> dict[str, Any]:
    """Return everything that ``paper.json`` says of one flight."""
    report = flight.report
    return {
        "folder": flight.folder.name,
        "leader": flight.result.plan.leader,
        "speed": report["options"]["speed"],
        "settings": report["options"]["settings"],
        "duration_s": report["duration_s"],
        "wall": report.get("wall"),
        "map": report["map"],
        "attention": [
            f"{event['drone']}: {event['reason']}"
            for event in report["events"]
            if event["kind"] == "harness"
        ],
        "drones": {
            drone.name: drone_measures(flight, drone, flight.estimates.get(drone.name))
            for drone in flight.result.drones
        },
    }


def drone_measures(
    flight: PaperFlight, drone: DroneResult, estimates: SourceEstimates | None
) -> dict[str, Any]:
    """Return one drone's flight in numbers."""
    of_report = flight.report["drones"][drone.name]
    errors = drone.errors
    by_source = {row.sequence: row for row in drone.log.frames}
    return {
        "frames": drone.n_frames,
        "localized_share": drone.n_localized / max(drone.n_frames, 1),
        "frames_refused": drone.log.count("refused"),
        "frames_dropped": drone.log.count("dropped"),
        "unaccounted": drone.unaccounted,
        "refusals": drone.log.refusals(),
        "rmse_cm": _per_axis(errors.position_ref_m) if errors else None,
        "rmse_3d_cm": _rms_3d_cm(errors.position_ref_m) if errors else None,
        "worst_cm": _worst_cm(errors),
        "yaw_rmse_deg": _rms_deg(errors.yaw_rad) if errors else None,
        "yaw_worst_deg": float(np.degrees(np.abs(errors.yaw_rad).max())) if errors else None,
        "within_3_sigma_share": of_report["within_3_sigma_share"],
        "nees_median": _nees(errors, estimates),
        "estimates": _counts(estimates),
        "peer_bytes_per_s": of_report["peer_bytes_per_s"],
        "tracked_median": of_report["landmarks"],
        "after_first_map": after_first_map(drone, by_source),
        "end": end_of(drone),
    }


def after_first_map(drone: DroneResult, rows: dict[int, Any]) -> dict[str, int] | None:
    """Return what became of the frames from the first localized or mapped one on.

    A frame is ``explained`` when it was localized, or refused with a reason.
    None when the drone never had a map.
    """
    if not drone.log.maps:
        return None
    since_ns = drone.log.maps[0].at_ns
    late = [n for n, at_ns in enumerate(drone.frames_at_ns.tolist()) if at_ns >= since_ns]
    told = [rows.get(n) for n in late]
    localized = sum(row is not None and row.outcome == "localized" for row in told)
    refused = sum(row is not None and row.outcome == "refused" and bool(row.reason) for row in told)
    return {"frames": len(late), "localized": localized, "refused_with_reason": refused}


def end_of(drone: DroneResult) -> dict[str, float] | None:
    """Return how far off the last pose was, when, and after how much of the way; None without."""
    errors = drone.errors
    if errors is None:
        return None
    way_m = path_length_m(drone)
    last = int(np.searchsorted(drone.frames_at_ns, errors.at_ns[-1]))
    drift_m = float(np.linalg.norm(errors.position_ref_m[-1]))
    before_end_s = float(drone.frames_at_ns[-1] - errors.at_ns[-1]) * 1e-9
    return {
        "drift_m": drift_m,
        "way_m": float(way_m[min(last, len(way_m) - 1)]),
        "whole_way_m": float(way_m[-1]),
        "before_end_s": before_end_s,
    }


def path_length_m(drone: DroneResult) -> Array:
    """Return (F,) how far the drone has flown until each frame, by the truth, m."""
    places = np.array([p.translation if p else np.full(3, np.nan) for p in drone.truth])
    known = ~np.isnan(places[:, 0])
    if not known.any():
        return np.zeros(len(places))
    steps = np.linalg.norm(np.diff(places[known], axis=0), axis=1)
    way = np.full(len(places), np.nan)
    way[known] = np.concatenate([[0.0], np.cumsum(steps)])
    index = np.arange(len(places))
    return np.asarray(np.interp(index, index[known], way[known]), dtype=np.float64)


def compared(fused: DroneResult, unfused: DroneResult) -> dict[str, Any] | None:
    """Return both flights over the frames that both localized; None when there is none.

    ``ratio`` is fused by unfused 3-D RMSE: below 1 when fusion helped.
    """
    a, b = fused.errors, unfused.errors
    if a is None or b is None:
        return None
    both, in_a, in_b = np.intersect1d(a.at_ns, b.at_ns, return_indices=True)
    if not len(both):
        return None
    with_m, without_m = a.position_ref_m[in_a], b.position_ref_m[in_b]
    fused_cm, unfused_cm = _rms_3d_cm(with_m), _rms_3d_cm(without_m)
    return {
        "frames": len(both),
        "fused_cm": {**_per_axis(with_m), "3d": fused_cm},
        "unfused_cm": {**_per_axis(without_m), "3d": unfused_cm},
        "ratio": fused_cm / unfused_cm if unfused_cm > 0.0 else None,
    }


def _nees(errors: PoseErrors | None, estimates: SourceEstimates | None) -> dict[str, float | None]:
    """Return the medians of own fixes and proposals that went in, of refused ones, and as sent."""
    out: dict[str, float | None] = {"intra": None, "inter": None, "inter_refused": None}
    if estimates is not None:
        nees = estimates.errors.nees
        out["intra"] = nees_median(nees[estimates.of("intra", fused=None)])
        out["inter"] = nees_median(nees[estimates.of("inter")])
        out["inter_refused"] = nees_median(nees[estimates.of("inter", fused=False)])
    out["sent"] = nees_median(errors.nees) if errors else None
    return out


def _counts(estimates: SourceEstimates | None) -> dict[str, Any] | None:
    if estimates is None:
        return None
    return {
        "intra": int(estimates.of("intra", fused=None).sum()),
        "inter": int(estimates.of("inter").sum()),
        "inter_refused": int(estimates.of("inter", fused=False).sum()),
        "inter_by_host": {
            host: int(np.sum(estimates.of("inter") & (estimates.hosts == host)))
            for host in estimates.by_host()
        },
    }


def _per_axis(errors_m: Array) -> dict[str, float]:
    rms = 100.0 * np.sqrt(np.mean(np.square(errors_m), axis=0))
    return dict(zip("xyz", map(float, rms), strict=True))


def _rms_3d_cm(errors_m: Array) -> float:
    return 100.0 * position_rms_m(errors_m)


def _rms_deg(errors_rad: Array) -> float:
    return float(np.degrees(np.sqrt(np.mean(np.square(errors_rad)))))


def _worst_cm(errors: PoseErrors | None) -> float | None:
    return float(100.0 * np.linalg.norm(errors.position_ref_m, axis=1).max()) if errors else None
