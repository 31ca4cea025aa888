"""How pictures look here: one style, colours for colour-blind readers too, SVG for a page."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vcl_companion.geometry.rotation import Array

# Okabe and Ito's colours, told apart by colour-blind readers too; yellow is left out.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
INK, FAINT, _GRID, POINT = "#1f2933", "#52606d", "#e4e7eb", "#b8c1cc"
REFUSED = "#c0392b"

# Text as outlines of matplotlib's own font: the page must look the same everywhere.
STYLE: dict[Any, Any] = {
    "svg.fonttype": "path",
    "svg.hashsalt": "sitl",
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": "#9aa5b1",
    "axes.labelcolor": FAINT,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": _GRID,
    "grid.linewidth": 0.8,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "legend.frameon": False,
    "lines.solid_capstyle": "round",
}
WIDTH_IN = 11.0
_MAX_DOTS = 400


def colour(n: int) -> str:
    """Return the colour of the n-th drone."""
    return _COLOURS[n % len(_COLOURS)]


def bulk(points: Array) -> Array:
    """Return the points but for far outliers, which would shrink the flight to a dot."""
    if len(points) < 10:
        return points
    low, high = np.percentile(points, [2.0, 98.0], axis=0)
    margin = 0.25 * (high - low)
    return points[np.all((points >= low - margin) & (points <= high + margin), axis=1)]


def dotted(n_points: int) -> str:
    """Return a line style: with a dot at every pose, unless there are too many to be told apart."""
    return ".-" if n_points <= _MAX_DOTS else "-"


def seconds(at_ns: Sequence[int], starts_at_ns: int) -> Array:
    """Return instants as seconds of the flight."""
    return np.asarray((np.array(at_ns, dtype=np.int64) - starts_at_ns) * 1e-9, dtype=np.float64)


def svg(figure: Figure, title: str) -> str:
    """Return the figure as an ``<svg>`` element that scales with the page."""
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None}, dpi=200)
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :]
    # The width and height would hold the picture at its size on paper.
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    return svg.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)
