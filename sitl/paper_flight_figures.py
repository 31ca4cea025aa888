"""Figures 8, 9, 10 and 12 in our data: where they flew, and how far off along each axis."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.ticker import MaxNLocator

from sitl.paper_figures import WITHOUT, legend_above, log_of_cm, norm_cm, on_frames
from sitl.paper_flights import PaperFlight
from sitl.paper_measures import path_length_m
from sitl.plotting import (
    FAINT,
    INK,
    POINT,
    REFUSED,
    STYLE,
    WIDTH_IN,
    bulk,
    colour,
    seconds,
    svg,
)
from sitl.result import DroneResult
from sitl.scenario import Scenario
from vcl_companion.geometry.rotation import Array

_AXES = (("X, depth", 0), ("Y, lateral", 1), ("Z, vertical", 2))


def trajectories_svg(fused: PaperFlight, unfused: PaperFlight | None) -> str:
    """Draw fig. 8: lateral place and height along the way, magnified across it."""
    names = fused.experiment.targets
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 5.6), layout="constrained")
        grid = figure.subplots(2, len(names), sharex=True, squeeze=False)
        for column, name in enumerate(names):
            for row, (axis, sign, label) in enumerate(
                ((1, 1.0, "Y, lateral [m]"), (2, -1.0, "height, −Z [m]"))
            ):
                axes = grid[row, column]
                for flight, ink, said in ((unfused, WITHOUT, "unfused"), (fused, None, "fused")):
                    if flight is not None:
                        drone = flight.drone(name)
                        shade = ink or colour(_number(flight, name))
                        _draw_path(axes, drone, axis, sign, shade, said)
                true = _true(fused.drone(name))
                axes.plot(
                    true[:, 0], sign * true[:, axis], color=INK, lw=1.0, dashes=(4, 2),
                    label="truth", zorder=3,
                )  # fmt: skip
                _focus_path(axes, fused.drone(name), axis, sign)
                axes.set_ylabel(label)
                legend_above(axes, 3)
            grid[0, column].set_title(name)
            grid[1, column].set_xlabel("X, depth: towards the façade [m]")
        return svg(figure, "Trajectories of the forward and backward flight")


def axis_errors_svg(fused: PaperFlight, unfused: PaperFlight | None, name: str) -> str:
    """Draw figs. 9 and 10: one drone's error along each axis with 3 sigma, fused and unfused."""
    flights = [flight for flight in (fused, unfused) if flight is not None]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 6.2), layout="constrained")
        grid = figure.subplots(3, len(flights), sharex=True, sharey="row", squeeze=False)
        for row, (label, axis) in enumerate(_AXES):
            highest = [1e-3]
            for column, flight in enumerate(flights):
                ink = colour(_number(flight, name)) if flight.fused else WITHOUT
                highest += _draw_axis(grid[row, column], flight, name, axis, ink)
            grid[row, 0].set_ylabel(f"{label} [cm]")
            grid[row, 0].set_ylim(-1.1 * max(highest), 1.1 * max(highest))
            grid[row, 0].yaxis.set_major_locator(MaxNLocator(5, symmetric=True))
        for column, flight in enumerate(flights):
            grid[0, column].set_title(f"{name}, {flight.variant}")
            legend_above(grid[0, column], 4)
            grid[2, column].set_xlabel("time [s]")
        return svg(figure, f"Error of {name} along each axis, fused and unfused")


def urban_svg(flight: PaperFlight, scenario: Scenario | None) -> str:
    """Draw fig. 12: the flight from above with map updates; landmarks and error over the way."""
    updates = map_updates(flight)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 6.6), layout="constrained")
        mosaic = figure.subplot_mosaic([["above", "tracked"], ["above", "drift"]])
        from_above, tracked, drift = mosaic["above"], mosaic["tracked"], mosaic["drift"]
        _draw_town(from_above, flight, scenario)
        leader = flight.drone(flight.result.plan.leader)
        way_m, true = path_length_m(leader), _true(leader)
        for n, drone in enumerate(flight.result.drones):
            _draw_over_way(tracked, drift, drone, colour(n))
        for k, (frame, _) in enumerate(updates):
            from_above.plot(
                true[frame, 1], true[frame, 0], "o", ms=12, mfc="white", mec=INK, mew=1.2,
                zorder=6, label="map update" if k == 0 else None,
            )  # fmt: skip
            from_above.annotate(
                str(k + 1), (true[frame, 1], true[frame, 0]), fontsize=7.5, ha="center",
                va="center_baseline", zorder=7,
            )  # fmt: skip
            for axes in (tracked, drift):
                axes.axvline(way_m[frame], color=INK, lw=0.9, dashes=(1, 2))
            tracked.annotate(
                str(k + 1), (way_m[frame], 1.0), xycoords=("data", "axes fraction"),
                xytext=(2, -9), textcoords="offset points", fontsize=8.0,
            )  # fmt: skip
        from_above.set(title="From above", xlabel="y, east [m]", ylabel="x, north [m]")
        from_above.legend(
            loc="upper right", bbox_to_anchor=(1.0, -0.09), ncols=3, fontsize=8.0, markerscale=0.8
        )
        tracked.set(ylabel="landmarks kept in the pose", xlim=(0.0, 1.03 * float(way_m[-1])))
        tracked.set_title("Tracked landmarks")
        tracked.set_ylim(bottom=0.0)
        legend_above(tracked, 4)
        drift.set(ylabel="3-D error [cm]", xlabel="way flown [m]")
        log_of_cm(drift)
        drift.set_xlim(0.0, 1.03 * float(way_m[-1]))
        drift.set_title("Drift; dotted: map updates")
        return svg(figure, "The urban flight from above, tracked landmarks and drift over the way")


def map_updates(flight: PaperFlight) -> list[tuple[int, int]]:
    """Return (leader's frame, landmarks) of every map after the first."""
    frames = flight.drone(flight.result.plan.leader).frames_at_ns
    out = []
    for row in flight.result.maps[1:]:
        frame = int(np.clip(np.searchsorted(frames, row.at_ns), 0, len(frames) - 1))
        out.append((frame, row.landmarks))
    return out


def _draw_path(
    axes: Axes, drone: DroneResult, axis: int, sign: float, ink: str, label: str
) -> None:
    if drone.errors is None:
        return
    sent = on_frames(drone, drone.errors.estimate_ref_m, drone.errors)
    axes.plot(sent[:, 0], sign * sent[:, axis], ".-", ms=2.5, lw=1.0, color=ink, label=label)


def _focus_path(axes: Axes, drone: DroneResult, axis: int, sign: float) -> None:
    """Show the fused path whole, whatever wild poses the other has."""
    values = sign * _true(drone)[:, axis]
    if drone.errors is not None:
        values = np.concatenate([values, sign * drone.errors.estimate_ref_m[:, axis]])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.12 * (high - low) + 0.1
    axes.set_ylim(low - margin, high + margin)


def _draw_axis(axes: Axes, flight: PaperFlight, name: str, axis: int, ink: str) -> list[float]:
    """Draw one axis of one flight; return what must be in view, cm."""
    drone = flight.drone(name)
    start = flight.result.plan.starts_at_ns
    at_s = seconds(drone.frames_at_ns.tolist(), start)
    axes.axhline(0.0, color="#9aa5b1", lw=0.8)
    axes.set_xlim(-0.03 * at_s[-1], 1.03 * at_s[-1])
    errors = drone.errors
    if errors is None:
        axes.text(0.5, 0.6, "never localized", transform=axes.transAxes, ha="center", color=FAINT)
        return []
    off = 100.0 * on_frames(drone, errors.position_ref_m[:, axis], errors)
    sigma = 100.0 * on_frames(drone, errors.position_sigma_ref_m[:, axis], errors)
    axes.fill_between(at_s, -3 * sigma, 3 * sigma, color=ink, alpha=0.15, lw=0, label="3σ as sent")
    axes.plot(at_s, off, ".-", ms=3, lw=1.1, color=ink, label="error")
    outside = np.abs(off) > 3 * sigma
    if outside.any():
        axes.plot(at_s[outside], off[outside], "o", ms=6, mfc="none", mec=REFUSED, mew=1.2,
                  label="outside")  # fmt: skip
    estimates = flight.estimates.get(name)
    if estimates is not None:
        helped = np.unique(estimates.errors.at_ns[estimates.of("inter")])
        axes.plot(
            seconds(helped.tolist(), start), np.full(len(helped), 0.02), "|", ms=8, mew=1.1,
            color=INK, transform=axes.get_xaxis_transform(), label="a proposal fused",
        )  # fmt: skip
    return [float(np.nanmax(np.abs(off))), 3.0 * float(np.nanpercentile(sigma, 90.0))]


def _draw_town(axes: Axes, flight: PaperFlight, scenario: Scenario | None) -> None:
    for footprint in footprints(scenario) if scenario is not None else []:
        axes.add_patch(Polygon(footprint[:, ::-1], fc="#eef1f4", ec="#cbd2d9", lw=0.8, zorder=0))
    points = bulk(flight.result.points_ref_m)
    if len(points):
        axes.plot(
            points[:, 1], points[:, 0], ".", ms=1.5, color=POINT, alpha=0.9, zorder=1,
            label="last map's landmarks", rasterized=True,
        )  # fmt: skip
    places = []
    for n, drone in enumerate(flight.result.drones):
        true = _true(drone)
        places.append(true)
        axes.plot(
            true[:, 1], true[:, 0], color=INK, lw=0.9, dashes=(4, 2), zorder=4,
            label="truth" if n == 0 else None,
        )  # fmt: skip
        if drone.errors is not None:
            sent = on_frames(drone, drone.errors.estimate_ref_m, drone.errors)
            axes.plot(
                sent[:, 1], sent[:, 0], ".-", ms=2.5, lw=1.3, color=colour(n), label=drone.name,
                zorder=3,
            )  # fmt: skip
    reach = np.concatenate(places)
    low, high = np.nanmin(reach[:, :2], axis=0) - 14.0, np.nanmax(reach[:, :2], axis=0) + 14.0
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(low[1], high[1]), ylim=(low[0], high[0]))


def footprints(scenario: Scenario) -> Sequence[Array]:
    """Return the (4, 2) corners, north and east in metres, of every building of a scenario."""
    out = []
    for building in scenario.world.building:
        angle = np.deg2rad(building.facing_deg)
        out_of_front = np.array([np.cos(angle), np.sin(angle)])
        along = np.array([-out_of_front[1], out_of_front[0]]) * building.width_m / 2
        front = np.array([building.x_m, building.y_m])
        back = front - building.depth_m * out_of_front
        out.append(np.array([front - along, front + along, back + along, back - along]))
    return out


def _draw_over_way(tracked: Axes, drift: Axes, drone: DroneResult, ink: str) -> None:
    way_m = path_length_m(drone)
    frames = {frame.sequence: frame for frame in drone.log.frames}
    kept = [frames[n].inliers if n in frames else np.nan for n in range(drone.n_frames)]
    tracked.plot(way_m, kept, color=ink, lw=1.2, label=drone.name)
    refused = [n for n, frame in frames.items() if frame.outcome == "refused"]
    if refused:
        tracked.plot(
            way_m[refused], np.zeros(len(refused)), "|", ms=6, mew=0.8, color=ink, clip_on=False
        )
    if drone.errors is not None:
        off_cm = on_frames(drone, norm_cm(drone.errors), drone.errors)
        drift.plot(way_m, off_cm, ".-", ms=2.5, color=ink, lw=1.2)


def _true(drone: DroneResult) -> Array:
    """Return (F, 3) true places; NaN where not known."""
    return np.array([p.translation if p else np.full(3, np.nan) for p in drone.truth])


def _number(flight: PaperFlight, name: str) -> int:
    return [drone.name for drone in flight.result.drones].index(name)
