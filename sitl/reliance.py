"""What the sent poses rely on, frame by frame: shares, and a strip of colour over the flight."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from sitl.flight_log import FrameRow
from sitl.plotting import INK, REFUSED, STYLE, WIDTH_IN, colour, seconds, svg
from sitl.result import FlightResult

Reliance = Literal["patches", "features", "odometry", "peer", "motion", "nothing"]

# Told apart by how light they are, too: what is darker stands firmer, red stands out.
RELIANCES: dict[Reliance, tuple[str, str]] = {
    "patches": ("map, by patches", "#1b4f72"),
    "features": ("map, by features", "#6fa8d6"),
    "odometry": ("own frames", "#5aa786"),
    "peer": ("a peer's word", "#b48ac0"),
    "motion": ("attitude and motion", "#f2c14e"),
    "nothing": ("nothing was sent", REFUSED),
}
_WIDTH = 0.62


def reliance(frame: FrameRow) -> Reliance:
    """Return what the pose sent for a frame relies on.

    A log of before patches does not say it of localized frames: it knew only features.
    """
    for known in RELIANCES:
        if frame.by == known:
            return known
    if frame.outcome != "localized" or frame.is_held_back:
        return "nothing"
    return "peer" if frame.source == "inter" else "features"


def shares(frames: Sequence[FrameRow]) -> dict[str, float]:
    """Return the share of a drone's frames that rely on each thing; 1 in all."""
    found = [reliance(frame) for frame in frames]
    return {name: found.count(name) / max(len(found), 1) for name in RELIANCES}


def strips_svg(result: FlightResult) -> str:
    """Draw each drone's flight as a strip; a tick above it where a peer's word was fused as well.

    A frame lasts until the next one.
    """
    with mpl.rc_context(STYLE):
        n_drones = len(result.drones)
        figure = Figure(figsize=(WIDTH_IN, 0.95 + 0.34 * n_drones), layout="constrained")
        axes = figure.subplots()
        for n, drone in enumerate(result.drones):
            frames = sorted(drone.log.frames, key=lambda frame: frame.captured_at_ns)
            if not frames:
                continue
            at_s = seconds([f.captured_at_ns for f in frames], result.plan.starts_at_ns)
            gap_s = float(np.median(np.diff(at_s))) if len(at_s) > 1 else 0.1
            ends_s = np.append(at_s[1:], at_s[-1] + gap_s)
            for name, run in groupby(range(len(frames)), key=lambda k: reliance(frames[k])):
                first, *rest = run
                last = rest[-1] if rest else first
                axes.broken_barh(
                    [(at_s[first], ends_s[last] - at_s[first])],
                    (n - _WIDTH / 2, _WIDTH), color=RELIANCES[name][1], lw=0,
                )  # fmt: skip
            fused = [f.source == "fused" for f in frames]
            axes.plot(
                (at_s + 0.5 * gap_s)[fused], np.full(sum(fused), n - 0.5 * _WIDTH - 0.09),
                "|", ms=5, mew=0.9, color=INK,
            )  # fmt: skip
        axes.set(xlabel="time [s]", ylim=(n_drones - 0.5, -0.5 - 0.1))
        axes.set_yticks(range(n_drones), [drone.name for drone in result.drones])
        for n, label in enumerate(axes.get_yticklabels()):
            label.set_color(colour(n))
        axes.tick_params(axis="y", length=0)
        axes.grid(axis="y", visible=False)
        axes.spines["left"].set_visible(False)
        axes.margins(x=0.01)
        figure.legend(
            handles=[Patch(color=ink, label=label) for label, ink in RELIANCES.values()],
            loc="outside upper left", ncols=len(RELIANCES), fontsize=8.5, handlelength=1.0,
            handleheight=1.0, columnspacing=1.4,
        )  # fmt: skip
        return svg(figure, "What the sent poses rely on over the flight")
