"""``bench realtime``: three daemons at 30 Hz on this machine: in time, and within their memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from sitl.bench.figures import Figure
from sitl.bench.speed_report import write_realtime
from sitl.fly import fly
from sitl.plan import FlyOptions
from sitl.render import render_scenario
from sitl.scenario import Scenario, load_scenario

Progress = Callable[[str, int, int], None]

_SCENARIO = "demo"
_RATE_HZ = 30.0
_QUICK_S, _QUICK_PX, _QUICK_HZ = 1.5, (320, 240), 15.0


def realtime_scenario(quick: bool) -> Scenario:
    """Return the flight: the demo's at 30 Hz; a short one of small images to see that it runs.

    Cameras of different drones run freely: one exposes after the other, evenly.
    """
    scenario = load_scenario(_SCENARIO)
    rate_hz = _QUICK_HZ if quick else _RATE_HZ
    drones = tuple(
        msgspec.structs.replace(drone, delay_s=k / len(scenario.drone) / rate_hz)
        for k, drone in enumerate(scenario.drone)
    )
    scenario = msgspec.structs.replace(scenario, drone=drones, frame_rate_hz=rate_hz)
    if not quick:
        return scenario
    lens = scenario.camera
    small = msgspec.structs.replace(
        lens,
        width_px=_QUICK_PX[0],
        height_px=_QUICK_PX[1],
        focal_px=lens.focal_px * _QUICK_PX[0] / lens.width_px,
    )
    return msgspec.structs.replace(scenario, camera=small, duration_s=_QUICK_S)


def bench_realtime(out: Path, quick: bool, progress: Progress) -> dict[str, tuple[Figure, ...]]:
    """Fly in the recording's own time and say what it cost: ``realtime.json``, ``realtime.md``.

    Args:
        out: folder; ``recording``, which is kept, and ``flight`` are made in it.
        quick: seconds, to see that it runs; its numbers mean nothing.
        progress: told what is done, how far it is, and of how much.
    """
    scenario = realtime_scenario(quick)
    recording = out / ("recording-quick" if quick else "recording")
    if not (recording / "recording.toml").exists():
        render_scenario(scenario, recording, lambda done, n: progress("rendering", done, n))
    report = fly(recording, out / "flight", FlyOptions(start_timeout_s=60.0), progress)
    daemons = {name: figures_of(drone) for name, drone in report["drones"].items()}
    small = f"{scenario.camera.width_px}x{scenario.camera.height_px}"
    write_realtime(
        out,
        daemons,
        f"{len(daemons)} daemons, {scenario.frame_rate_hz:g} Hz, {small}, "
        f"{report['duration_s']:.0f} s, cameras one after the other, the harness and its "
        "stand-in autopilots on the same machine; wall time, what else the machine does counts.",
    )
    return daemons


def figures_of(drone: Mapping[str, Any]) -> tuple[Figure, ...]:
    """Return what ``report.json`` says of a drone, beside the goals."""

    def number(value: float | None) -> float:
        return math.nan if value is None else value

    latency = drone["latency_ms"]
    return (
        Figure("frames", drone["frames"], ""),
        Figure("localized", 100.0 * drone["localized_share"], "%", 99.0, at_least=True),
        Figure("dropped", 100.0 * drone["frames_dropped"] / drone["frames"], "%", 1.0),
        Figure("arrival to wire, p50", number(latency["p50"]), "ms"),
        Figure("arrival to wire, p95", number(latency["p95"]), "ms"),
        Figure("arrival to wire, p99", number(latency["p99"]), "ms", 25.0),
        Figure("resident, most", number(drone["resident_mb"]), "MB", 300.0),
        Figure("share of a core", 100.0 * number(drone["cpu_share"]), "%"),
        Figure("ATE", 100.0 * number(drone["ate_m"]), "cm"),
    )
