"""The report's pictures, as SVG text: where the drones flew, how far off, on how much, how fast."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sitl.evaluation import PoseErrors
from sitl.plotting import (
    FAINT,
    INK,
    POINT,
    REFUSED,
    STYLE,
    WIDTH_IN,
    bulk,
    colour,
    dotted,
    seconds,
    svg,
)
from sitl.recording_axes import along_axes, axis_names, axis_to, sigmas_along_axes
from sitl.result import DroneResult, FlightResult
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import ReferenceAxes


def trajectories_svg(result: FlightResult) -> str:
    """Draw the flight from above (east to the right, north up) and from the side, to scale."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 5.6), layout="constrained")
        above, side = figure.subplots(1, 2)
        _draw_flight(above, result, across=1, up=0, up_sign=1.0)
        _draw_flight(side, result, across=0, up=2, up_sign=-1.0)
        east, north, height = _directions(result)
        above.set(title="From above", xlabel=east, ylabel=north)
        side.set(title="From the side", xlabel=north, ylabel=height)
        handles, labels = above.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(labels), markerscale=1.6
        )
        return svg(figure, "Trajectories from above and from the side")


def errors_svg(result: FlightResult) -> str | None:
    """Draw the error along the recording's axes with its 3-sigma band; None without truth."""
    shown = [(n, d) for n, d in enumerate(result.drones) if d.errors is not None]
    if not shown:
        return None
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 7.2), layout="constrained")
        grid = figure.subplots(4, len(shown), sharex=True, sharey="row", squeeze=False)
        for column, (n, drone) in enumerate(shown):
            _draw_errors(list(grid[:, column]), drone, colour(n), result.plan.starts_at_ns)
            kind = "" if result.axes else f" ({drone.axes})"
            grid[0, column].set_title(drone.name + kind, color=colour(n))
            grid[3, column].set(xlabel="time [s]", xlim=_time_limits(result))
        labels = [f"{name} [cm]" for name in axis_names(result.axes)]
        for row, label in enumerate((*labels, "yaw [°]")):
            grid[row, 0].set_ylabel(label)
            _focus_errors(grid[row, 0], shown, row)
        return svg(figure, "Error along every axis with the sent 3-sigma band")


def landmarks_svg(result: FlightResult) -> str:
    """Draw how many landmarks each frame matched and kept; refused and dropped frames marked."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
        axes = figure.subplots(1, len(result.drones), sharey=True, squeeze=False)[0]
        for n, drone in enumerate(result.drones):
            frames = sorted(drone.log.frames, key=lambda frame: frame.captured_at_ns)
            at_s = seconds([f.captured_at_ns for f in frames], result.plan.starts_at_ns)
            looked_at = np.array([f.outcome != "dropped" for f in frames], dtype=bool)
            matched = np.array([f.matched for f in frames], dtype=float)
            inliers = np.array([f.inliers for f in frames], dtype=float)
            matched[~looked_at] = inliers[~looked_at] = np.nan
            axes[n].plot(at_s, matched, color=POINT, lw=1.2, label="matched")
            axes[n].plot(at_s, inliers, color=colour(n), lw=1.8, label="kept in the pose")
            _mark_outcomes(axes[n], at_s, [f.outcome for f in frames])
            axes[n].set(title=drone.name, xlabel="time [s]", xlim=_time_limits(result))
            axes[n].legend(
                loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=4, fontsize=8.0,
                borderpad=0.0, columnspacing=1.0, handlelength=1.3, handletextpad=0.5,
            )  # fmt: skip
        axes[0].set_ylim(bottom=0.0)
        axes[0].set_ylabel("landmarks")
        return svg(figure, "Tracked landmarks")


def latency_svg(result: FlightResult) -> str:
    """Draw every frame's latency in the daemon, and how it is distributed."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
        over_time, share = figure.subplots(1, 2, width_ratios=(2, 1))
        for n, drone in enumerate(result.drones):
            frames = drone.looked_at
            at_s = seconds([f.captured_at_ns for f in frames], result.plan.starts_at_ns)
            latency_ms = np.array([f.latency_ms for f in frames], dtype=float)
            over_time.plot(
                at_s, latency_ms, dotted(len(at_s)), ms=4, lw=0.9, color=colour(n),
                label=drone.name,
            )  # fmt: skip
            if len(latency_ms):
                rising = np.sort(latency_ms)
                part = np.arange(1, len(rising) + 1) / len(rising) * 100.0
                share.step(rising, part, where="post", color=colour(n), lw=1.6)
        over_time.set(title="Latency of each frame", xlabel="time [s]", ylabel="latency [ms]")
        over_time.set_xlim(_time_limits(result))
        over_time.set_ylim(bottom=0.0)
        over_time.legend(
            loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=len(result.drones), fontsize=8.5
        )
        share.set(title="Frames done within", xlabel="latency [ms]", ylabel="frames [%]")
        share.set_ylim(0.0, 102.0)
        share.set_xlim(left=0.0)
        return svg(figure, "Latency")


def _draw_flight(axes: Axes, result: FlightResult, across: int, up: int, up_sign: float) -> None:
    points = bulk(result.points_ref_m)
    if len(points):
        axes.plot(
            points[:, across], up_sign * points[:, up], ".", ms=2.0, color=POINT, alpha=0.8,
            label="map points", zorder=1, rasterized=True,
        )  # fmt: skip
    is_named = False  # in the legend, once: the first drone need not have a truth
    for n, drone in enumerate(result.drones):
        true = np.array([pose.translation for pose in drone.truth if pose is not None])
        if len(true) and result.ref_from_world is not None:
            axes.plot(
                true[:, across], up_sign * true[:, up], color=INK, lw=1.0, dashes=(4, 2),
                label=None if is_named else "truth", zorder=3,
            )  # fmt: skip
            is_named = True
        estimated = _estimated_ref_m(result, drone)
        if len(estimated):
            axes.plot(
                estimated[:, across], up_sign * estimated[:, up], dotted(len(estimated)),
                ms=4.5, lw=1.4,
                color=colour(n), label=drone.name, zorder=2,
            )  # fmt: skip
            axes.plot(
                estimated[0, across], up_sign * estimated[0, up], "o", ms=8, mfc="white",
                mec=colour(n), mew=1.8, zorder=4,
            )  # fmt: skip
    axes.margins(0.06)
    axes.set_aspect("equal", adjustable="datalim")


def _estimated_ref_m(result: FlightResult, drone: DroneResult) -> Array:
    """Return (T, 3) received positions where the leader's start puts them, else in world."""
    carry = result.ref_from_world or Pose.identity()
    poses = drone.estimates.world_from_body
    positions = [(carry @ pose).translation for pose in poses]
    return np.array(positions, dtype=np.float64).reshape(-1, 3)


def _draw_errors(column: Sequence[Axes], drone: DroneResult, ink: str, starts_at_ns: int) -> None:
    errors = drone.errors
    if errors is None:
        return
    # At the frames' own instants, so that a frame without a pose breaks the line.
    at_s = seconds(drone.frames_at_ns.tolist(), starts_at_ns)
    place = np.searchsorted(drone.frames_at_ns, errors.at_ns)
    for row, axes in enumerate(column):
        error, sigma = np.full((2, len(at_s)), np.nan)
        error[place], sigma[place] = _error_and_sigma(errors, drone.axes, row)
        axes.fill_between(at_s, -3 * sigma, 3 * sigma, color=ink, alpha=0.14, lw=0)
        axes.axhline(0.0, color="#9aa5b1", lw=0.8)
        axes.plot(at_s, error, dotted(len(at_s)), ms=3.5, lw=1.2, color=ink)
        outside = np.abs(error) > 3 * sigma
        axes.plot(at_s[outside], error[outside], "o", ms=6, mfc="none", mec=REFUSED, mew=1.3)


def _focus_errors(axes: Axes, shown: Sequence[tuple[int, DroneResult]], row: int) -> None:
    """Show every error, and the bands but for the few widest."""
    highest = [1e-3]
    for _, drone in shown:
        if drone.errors is None:
            continue
        error, sigma = _error_and_sigma(drone.errors, drone.axes, row)
        highest.append(float(np.abs(error).max()))
        known = sigma[np.isfinite(sigma)]
        if len(known):
            highest.append(3.0 * float(np.percentile(known, 90.0)))
    axes.set_ylim(-1.15 * max(highest), 1.15 * max(highest))
    axes.yaxis.set_major_locator(MaxNLocator(5, symmetric=True))


def _error_and_sigma(errors: PoseErrors, axes: ReferenceAxes, row: int) -> tuple[Array, Array]:
    """Return (T,) errors and sent sigmas: x, y, z in cm, then the heading in degrees."""
    if row == 3:
        return np.degrees(errors.yaw_rad), np.degrees(errors.yaw_sigma_rad)
    error_m = along_axes(errors.position_ref_m, axes)
    sigma_m = sigmas_along_axes(errors.position_sigma_ref_m, axes)
    return 100.0 * error_m[:, row], 100.0 * sigma_m[:, row]


def _mark_outcomes(axes: Axes, at_s: Array, outcomes: Sequence[str]) -> None:
    """Put refused and dropped frames at the foot of the plot."""
    for outcome, mark, ink in (("refused", "x", REFUSED), ("dropped", "|", FAINT)):
        here = at_s[np.array([o == outcome for o in outcomes], dtype=bool)]
        if len(here):
            axes.plot(
                here, np.zeros(len(here)), mark, ms=6, mew=1.4, color=ink,
                label=outcome, clip_on=False, zorder=5,
            )  # fmt: skip


def _time_limits(result: FlightResult) -> tuple[float, float]:
    """Return the ends of the time axis: the whole flight, even where nothing was localized."""
    duration_s = max(1e-3, (result.plan.ends_at_ns - result.plan.starts_at_ns) * 1e-9)
    return -0.03 * duration_s, 1.03 * duration_s


def _directions(result: FlightResult) -> tuple[str, str, str]:
    """Return the labels of what is drawn to the east, to the north and upwards."""
    if result.ref_from_world is None:
        return "y of world [m]", "x of world [m]", "height, −z of world [m]"
    axes = result.axes
    if axes is None:
        return "east [m]", "north [m]", "height [m]"
    east, north, up = (axis_to(way, axes) for way in ("east", "north", "up"))
    return f"{east}, east [m]", f"{north}, north [m]", f"height, {up} [m]"
