"""What a flight comes to: ``report.json``, and ``report.html`` for people.

Terms beyond ``sitl.evaluation``'s:

* ``axes``: of the recording's files; ``rmse_m`` is along them.
* ``localized_share``: frames whose pose reached the autopilot, of all frames; not those
  by attitude and motion alone, which count as refused (errors are of all that was sent).
* ``frames_localized``, ``frames_refused``, ``frames_dropped``: what the daemon's
  log says of each frame; ``unaccounted`` is what it says nothing about.
* ``latency_ms``: from a frame's arrival in the daemon to its outcome, of frames
  that were looked at. The first frames that the recording stands still with until there
  is a first map wait for that by design, and are told apart as ``first_frame_ms``; null for
  who begins later.
* ``landmarks``: median number of landmarks that a frame's own pose rests on.
* ``sources``: ``share`` of the frames whose pose was the frame's own (``intra``),
  a peer's alone (``inter``), or both (``fused``); ``nees_median`` and ``ate_m`` of
  the frames' own fixes, of the peers' proposals, and of what was sent; how many
  ``proposals`` came and how many of them were ``proposals_fused``.
* ``relies_on``: share of the frames whose sent pose relies on the map by ``patches`` or by
  ``features``, on the drone's own last frames where the map ends (``odometry``), on a ``peer``
  alone, on attitude and ``motion`` alone, or where ``nothing`` was sent.
* ``between``: poses between frames that the autopilot received (``[autopilot] min_rate_hz``):
  how many, and their ``ate_m``, the truth interpolated; no other number here is of them.
* ``fused``: what a real autopilot made of our poses (``sitl.fused``); null for a stand-in.
* ``mission``: how well it was flown (``sitl.flown_mission``); null in a recorded flight.
* ``lives``: each run of its daemon, in seconds of the recording: when its process was
  ``started_s``, when it was ``ready_s`` (it had connected to its camera, and begins to speak to
  autopilot and peers; starting an interpreter and compiling is before), and when it was
  ``killed_s``. ``seconds_to_map``, ``seconds_to_newest_map`` and ``seconds_to_localized``: from
  there, in seconds of the wall clock, to its first map, to one that another was on as well,
  and to the first pose that it sent; null for who is there from the start, when the recording
  waits for the map. Who was killed is judged by the frames that its daemon was given while it
  lived, and answered; ``peer_bytes_sent`` and the load are the last run's.
* ``phases``: before, during and after each partition (``sitl.phases``).
* ``peer_bytes_per_s``: sent to the other drones, per second of recording time.
* ``peer_link``: the same by message, and what became of it (``sitl.network_report``).
* ``map``: the leader's last ``revision``; ``revisions`` counts all of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sitl.lives_report import lives_of
from sitl.network_report import options_of, peer_link_of
from sitl.phases import phases_of
from sitl.plan import FlyOptions, pipeline_of
from sitl.reliance import shares
from sitl.report_page import page
from sitl.result import DroneResult, FlightResult


def write_report(
    result: FlightResult,
    out: Path,
    *,
    start_s: float,
    flight_s: float,
    late_ms: float | None,
) -> dict[str, Any]:
    """Write ``report.json`` and ``report.html`` into ``out`` and return the former's content.

    Args:
        result: the flight.
        out: an existing folder.
        start_s: wall time from the first frame to the first map.
        flight_s: wall time of the rest.
        late_ms: p99 of how much later than due the harness handed out frames;
            None when it kept no pace.
    """
    report = report_of(result)
    report["wall"] = rounded({"start_s": start_s, "flight_s": flight_s, "late_p99_ms": late_ms})
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    (out / "report.json").write_text(text + "\n", encoding="utf-8")
    (out / "report.html").write_text(page(result, report), encoding="utf-8")
    return report


def report_of(result: FlightResult) -> dict[str, Any]:
    """Return a flight's report as JSON knows it: no NaN, what is not known is null."""
    plan = result.plan
    last_map = result.maps[-1] if result.maps else None
    duration_s = (plan.ends_at_ns - plan.starts_at_ns) * 1e-9
    options = plan.options
    report = {
        "recording": plan.recording.name,
        "pipeline": pipeline_of(options.settings),
        "options": {
            "speed": "max" if math.isinf(options.speed) else options.speed,
            "drones": [drone.name for drone in plan.drones],
            "leader": plan.leader,
            "known_distances_m": {
                f"{_name(result, a)}:{_name(result, b)}": distance_m
                for a, b, distance_m in plan.known_distances
            },
            "autopilot": options.firmware.kind if options.firmware else "stand-in",
            "parameters": dict(options.firmware.parameters) if options.firmware else {},
            "attitude": _attitude_of(options),
            "seed": options.seed,
            "network": options_of(options.network),
            "start_timeout_s": options.start_timeout_s,
            "absences": [str(absence) for absence in options.absences],
            "blind": [str(blindness) for blindness in options.blind],
            "settings": {".".join(setting.path): setting.value for setting in options.settings},
        },
        "drones": {
            drone.name: {
                **_drone(drone, duration_s),
                "lives": lives_of(result, drone),
                "phases": phases_of(result, drone),
                "peer_link": peer_link_of(result.network, drone.name, duration_s),
            }
            for drone in result.drones
        },
        "map": {
            "revision": last_map.revision if last_map else None,
            "revisions": len({row.revision for row in result.maps}),
            "landmarks": last_map.landmarks if last_map else 0,
            "bytes": last_map.bytes if last_map else 0,
            "keyframes": last_map.keyframes if last_map else 0,
        },
        "events": [
            {"at_s": event.at_s, "drone": event.drone, "kind": event.kind, "reason": event.reason}
            for event in result.events
        ],
        "duration_s": duration_s,
    }
    # Options stay exact: whoever repeats the flight needs all of their digits.
    return {**rounded(report), "options": report["options"]}


def _attitude_of(options: FlyOptions) -> str:
    if options.firmware:
        return "the autopilot's own"
    return "replayed" if options.attitude else "from truth with noise"


def _drone(drone: DroneResult, duration_s: float) -> dict[str, Any]:
    scores, log, summary = drone.scores, drone.log, drone.log.summary
    first = [f.latency_ms for f in log.frames if drone.waits_for_map and f.sequence == 0]
    looked_at = [frame.latency_ms for frame in drone.looked_at if frame.latency_ms is not None]
    localized = [frame for frame in log.frames if frame.outcome == "localized"]
    inliers = [frame.inliers for frame in localized if frame.source != "inter"]
    sent = summary.peer_bytes_sent if summary else None
    return {
        "frames": drone.n_frames,
        "localized_share": drone.n_localized / max(drone.n_frames, 1),
        "frames_localized": log.count("localized"),
        "frames_refused": log.count("refused"),
        "frames_dropped": log.count("dropped"),
        "unaccounted": drone.unaccounted,
        "refusals": log.refusals(),
        "ate_m": scores.ate_m if scores else None,
        "ate_aligned_m": scores.ate_aligned_m if scores else None,
        "worst_m": scores.worst_m if scores else None,
        "axes": drone.axes,
        "rmse_m": dict(zip("xyz", scores.rmse_m if scores else (None,) * 3, strict=True)),
        "yaw_rmse_deg": scores.yaw_rmse_deg if scores else None,
        "within_3_sigma_share": scores.within_3_sigma_share if scores else None,
        "within_3_sigma_or_10cm_share": scores.within_3_sigma_or_10cm_share if scores else None,
        "nees_median": scores.nees_median if scores else None,
        "relies_on": shares(log.frames),
        "between": {
            "poses": drone.n_between,
            "ate_m": drone.between.ate_m if drone.between else None,
            "within_3_sigma_share": drone.between.within_3_sigma_share if drone.between else None,
        },
        "fused": asdict(drone.fused) if drone.fused else None,
        "mission": asdict(drone.mission) if drone.mission else None,
        "sources": _sources(drone),
        "latency_ms": {
            name: _percentile(looked_at, share)
            for name, share in (("p50", 50.0), ("p95", 95.0), ("p99", 99.0))
        },
        "first_frame_ms": first[0] if first else None,
        "cpu_share": summary.cpu_s / summary.wall_s if summary and summary.wall_s > 0 else None,
        "resident_mb": summary.resident_mb if summary else None,
        "peer_bytes_per_s": sent / duration_s if sent is not None and duration_s > 0 else None,
        "peer_bytes_sent": sent,
        "landmarks": float(np.median(inliers)) if inliers else 0,
    }


def _sources(drone: DroneResult) -> dict[str, Any]:
    judged = {"sent": drone.scores, **{s: drone.alone.get(s) for s in ("intra", "inter")}}
    proposals = [row for row in drone.log.estimates if row.source == "inter"]
    return {
        "share": {s: drone.log.share_from(s) for s in ("intra", "inter", "fused")},
        "nees_median": {k: scores.nees_median if scores else None for k, scores in judged.items()},
        "ate_m": {k: scores.ate_m if scores else None for k, scores in judged.items()},
        "proposals": len(proposals),
        "proposals_fused": sum(row.fused for row in proposals),
    }


def _name(result: FlightResult, system_id: int) -> str:
    return next(d.name for d in result.plan.drones if d.system_id == system_id)


def _percentile(values: Sequence[float], percent: float) -> float | None:
    return float(np.percentile(values, percent)) if values else None


def rounded(value: Any) -> Any:
    """Return JSON-like data with floats to six decimals and what is not finite as null."""
    if isinstance(value, dict):
        return {key: rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(inner) for inner in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
