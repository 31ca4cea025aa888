"""Figures 5 and 7 in our data: what each source said, and what came of it.

One language in all of them: dashed ink is the truth, a solid line what the
autopilot received, grey dots the drone's own fixes, coloured dots proposals in
the colour of the drone that made them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from sitl.evaluation import PoseErrors
from sitl.paper_estimates import SourceEstimates
from sitl.paper_flights import PaperFlight
from sitl.plotting import FAINT, INK, REFUSED, STYLE, WIDTH_IN, colour, seconds, svg
from sitl.result import DroneResult, FlightResult
from vcl_companion.geometry.rotation import Array

OWN = "#8a96a3"
WITHOUT = "#8c564b"
_TRUTH: dict[str, Any] = {"color": INK, "lw": 1.1, "dashes": (4, 2), "zorder": 3}


def rotate_svg(flight: PaperFlight) -> str:
    """Draw fig. 5: heading and its error by source, and which observer was the surest."""
    drone = flight.drone(flight.experiment.targets[0])
    estimates = flight.estimates.get(drone.name)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 7.0), layout="constrained")
        heading, error, surest = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1))
        at_s = seconds(drone.frames_at_ns.tolist(), flight.result.plan.starts_at_ns)
        true_deg = true_headings_deg(drone)
        _draw_sent_yaw(error, flight.result, drone)
        if estimates is not None:
            true_of = dict(zip(drone.frames_at_ns.tolist(), true_deg.tolist(), strict=True))
            for label, ink, mask in sources(estimates, flight.result):
                errors = estimates.errors
                when = seconds(errors.at_ns[mask].tolist(), flight.result.plan.starts_at_ns)
                off_deg = np.degrees(errors.yaw_rad[mask])
                said = np.array([true_of[t] for t in errors.at_ns[mask].tolist()]) + off_deg
                size = 3.0 if ink == OWN else 5.0
                heading.plot(when, said, ".", ms=size + 1, color=ink, label=label, zorder=2)
                error.plot(when, off_deg, ".", ms=size, color=ink, zorder=2)
            _draw_surest(surest, estimates, flight.result)
        heading.plot(at_s, true_deg, label="truth", **_TRUTH)
        heading.set(ylabel="heading [°]", title=f"Heading of {drone.name}, by source")
        legend_above(heading, 5)
        for limit in (-0.5, 0.5):
            error.axhline(limit, color=REFUSED, lw=0.9, dashes=(2, 3))
        error.set_ylim(*_yaw_limits(drone, estimates))
        error.set(ylabel="heading error [°]", title="Its error; dotted: 0.5°, the most allowed")
        legend_above(error, 3)
        surest.set(xlabel="time [s]", title="Surest observer")
        return svg(figure, "Heading of the turning drone by source, its error, surest observer")


def sparse_svg(fused: PaperFlight, unfused: PaperFlight | None) -> str:
    """Draw fig. 7: the targets' height by source, their error, and what they tracked."""
    names = fused.experiment.targets
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 8.2), layout="constrained")
        grid = figure.subplots(
            3, len(names), sharex=True, sharey="row", squeeze=False, height_ratios=(2, 3, 2)
        )
        for column, name in enumerate(names):
            height, error, tracked = grid[:, column]
            drone, estimates = fused.drone(name), fused.estimates.get(name)
            start = fused.result.plan.starts_at_ns
            at_s = seconds(drone.frames_at_ns.tolist(), start)
            if unfused is not None:
                _draw_errors_3d(error, unfused.drone(name), at_s, WITHOUT, "sent without fusion")
            if estimates is not None:
                for label, ink, mask in sources(estimates, fused.result):
                    when = seconds(estimates.errors.at_ns[mask].tolist(), start)
                    said = estimates.errors.estimate_ref_m[mask]
                    off_cm = 100 * np.linalg.norm(estimates.errors.position_ref_m[mask], axis=1)
                    size = 3.5 if ink == OWN else 5.5
                    height.plot(when, -said[:, 2], ".", ms=size, color=ink, label=label, zorder=2)
                    error.plot(when, off_cm, ".", ms=size, color=ink, zorder=2)
            _draw_height(height, drone, at_s)
            _draw_errors_3d(error, drone, at_s, INK, "sent with fusion")
            _draw_tracked(tracked, fused, unfused, name)
            height.set_title(name)
            tracked.set_xlabel("time [s]")
            for axes in (height, error, tracked):
                legend_above(axes, 5)
        grid[0, 0].set_ylabel("height, −z [m]")
        _focus_height(grid[0, 0], [fused.drone(name) for name in names])
        grid[1, 0].set_ylabel("3-D error [cm]")
        log_of_cm(grid[1, 0])
        grid[2, 0].set_ylabel("landmarks kept in the pose")
        return svg(figure, "Height of both targets by source, 3-D error, tracked landmarks")


def sources(
    estimates: SourceEstimates, flight: FlightResult
) -> Sequence[tuple[str, str, np.ndarray]]:
    """Return (label, colour, mask) of what a drone's estimates come from; fused ones only."""
    names = [drone.name for drone in flight.drones]
    out = [("own fix", OWN, estimates.of("intra"))]
    for host in estimates.by_host():
        ink = colour(names.index(host)) if host in names else FAINT
        out.append((f"from {host}", ink, estimates.of("inter") & (estimates.hosts == host)))
    return [row for row in out if row[2].any()]


def true_headings_deg(drone: DroneResult) -> Array:
    """Return (F,) true headings without jumps at 180 degrees; NaN without truth."""
    yaw = [np.arctan2(p.rotation[1, 0], p.rotation[0, 0]) if p else np.nan for p in drone.truth]
    values = np.array(yaw, dtype=np.float64)
    known = ~np.isnan(values)
    values[known] = np.degrees(np.unwrap(values[known]))
    return values


def on_frames(drone: DroneResult, values: Array, errors: PoseErrors) -> Array:
    """Return (F, ...) values at the drone's frames; NaN breaks the line where none was sent."""
    out = np.full((len(drone.frames_at_ns), *values.shape[1:]), np.nan)
    out[np.searchsorted(drone.frames_at_ns, errors.at_ns)] = values
    return out


def legend_above(axes: Axes, columns: int) -> None:
    """Put a legend over the axes at the right, never on data; none where nothing is labelled."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=columns, fontsize=8.0,
            borderpad=0.0, columnspacing=1.0, handlelength=1.6, handletextpad=0.5,
        )  # fmt: skip


def log_of_cm(axes: Axes) -> None:
    """Give errors a logarithmic axis in plain numbers, down to a millimetre.

    The leader's first error is zero by construction and would stretch it for ever.
    """
    axes.set_yscale("log")
    axes.set_ylim(bottom=max(0.1, axes.get_ylim()[0]))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def norm_cm(errors: PoseErrors) -> Array:
    """Return (T,) lengths of the position errors, cm; NaN for what is zero by construction."""
    off_cm = 100.0 * np.linalg.norm(errors.position_ref_m, axis=1)
    return np.where(off_cm > 1e-9, off_cm, np.nan)


def _draw_sent_yaw(axes: Axes, flight: FlightResult, drone: DroneResult) -> None:
    errors = drone.errors
    if errors is None:
        return
    at_s = seconds(drone.frames_at_ns.tolist(), flight.plan.starts_at_ns)
    off = on_frames(drone, np.degrees(errors.yaw_rad), errors)
    sigma = on_frames(drone, np.degrees(errors.yaw_sigma_rad), errors)
    axes.fill_between(
        at_s, -3 * sigma, 3 * sigma, color=INK, alpha=0.10, lw=0, label="its 3σ", zorder=1
    )
    axes.plot(at_s, off, color=INK, lw=1.3, label="sent", zorder=4)


def _yaw_limits(drone: DroneResult, estimates: SourceEstimates | None) -> tuple[float, float]:
    """Show the limit, all that was sent, and the sources but for a few wild ones."""
    values = [0.6]
    if drone.errors is not None:
        values.append(1.1 * float(np.degrees(np.abs(drone.errors.yaw_rad).max())))
    if estimates is not None and len(estimates.errors.yaw_rad):
        values.append(1.1 * float(np.degrees(np.percentile(np.abs(estimates.errors.yaw_rad), 97))))
    return -max(values), max(values)


def _draw_surest(axes: Axes, estimates: SourceEstimates, flight: FlightResult) -> None:
    instants, hosts = estimates.surest_host()
    at_s = seconds(instants.tolist(), flight.plan.starts_at_ns)
    names = estimates.by_host()
    known = [drone.name for drone in flight.drones]
    for row, name in enumerate(names):
        here = at_s[np.array([host == name for host in hosts], dtype=bool)]
        ink = colour(known.index(name)) if name in known else FAINT
        axes.plot(here, np.full(len(here), row), "s", ms=4, color=ink)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.grid(axis="y", visible=False)


def _draw_height(axes: Axes, drone: DroneResult, at_s: Array) -> None:
    if drone.errors is not None:
        sent = on_frames(drone, drone.errors.estimate_ref_m, drone.errors)
        axes.plot(at_s, -sent[:, 2], color=INK, lw=1.4, alpha=0.75, label="sent", zorder=3)
    true = np.array([-p.translation[2] if p else np.nan for p in drone.truth])
    axes.plot(at_s, true, label="truth", **_TRUTH)


def _focus_height(axes: Axes, drones: Sequence[DroneResult]) -> None:
    """Show the flight, not pressed flat by a wild estimate: those are in the row of errors."""
    heights = [-p.translation[2] for drone in drones for p in drone.truth if p]
    if heights:
        margin = 0.15 * (max(heights) - min(heights)) + 0.5
        axes.set_ylim(min(heights) - margin, max(heights) + margin)


def _draw_errors_3d(axes: Axes, drone: DroneResult, at_s: Array, ink: str, label: str) -> None:
    if drone.errors is None:
        return
    off_cm = norm_cm(drone.errors)
    axes.plot(
        at_s, on_frames(drone, off_cm, drone.errors), ".-", ms=3, lw=1.3, color=ink, label=label
    )


def _draw_tracked(axes: Axes, fused: PaperFlight, unfused: PaperFlight | None, name: str) -> None:
    start = fused.result.plan.starts_at_ns
    frames = sorted(fused.drone(name).log.frames, key=lambda frame: frame.captured_at_ns)
    at_s = seconds([frame.captured_at_ns for frame in frames], start)
    axes.plot(at_s, [frame.inliers for frame in frames], color=INK, lw=1.3, label="kept")
    top = max([frame.inliers for frame in frames], default=1)
    rows = [(fused, REFUSED, "refused with fusion", -0.06)]
    if unfused is not None:
        rows.append((unfused, WITHOUT, "refused without", -0.13))
    for flight, ink, label, share in rows:
        refused = [
            f.captured_at_ns for f in flight.drone(name).log.frames if f.outcome == "refused"
        ]
        here = seconds(refused, start)
        axes.plot(here, np.full(len(here), share * top), "x", ms=4, mew=1.2, color=ink, label=label)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
