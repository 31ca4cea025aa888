"""A recording's own axes in a report: its errors are along them, its pictures are labelled by them.

All that is computed is in NED. A picture from above has north up and east to the right whatever the
recording calls these.
"""

from __future__ import annotations

from typing import Literal

from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import NED_FROM_REFERENCE, ReferenceAxes

_AXES: dict[ReferenceAxes, tuple[str, str, str]] = {
    "NED": ("north", "east", "down"),
    "ENU": ("east", "north", "up"),
    "NWU": ("north", "west", "up"),
}
_OPPOSITE = {"north": "south", "east": "west", "up": "down"}


def axes_from_ned(axes: ReferenceAxes) -> Array:
    """Return the (3, 3) rotation into a recording's axes."""
    return NED_FROM_REFERENCE[axes].T


def along_axes(errors_m: Array, axes: ReferenceAxes) -> Array:
    """Return (T, 3) errors in NED as those along a recording's axes."""
    return errors_m @ axes_from_ned(axes).T


def sigmas_along_axes(sigmas_m: Array, axes: ReferenceAxes) -> Array:
    """Return (T, 3) sigmas along N, E and D as those along a recording's axes, each of them one."""
    return sigmas_m @ abs(axes_from_ned(axes)).T


def axis_names(axes: ReferenceAxes | None) -> list[str]:
    """Return what x, y and z are called; None for axes that are not known, or of several kinds."""
    ways = ("", "", "") if axes is None else _AXES[axes]
    return [f"{letter}, {way}" if way else letter for letter, way in zip("xyz", ways, strict=True)]


def axis_to(way: Literal["north", "east", "up"], axes: ReferenceAxes) -> str:
    """Return the signed axis of a recording that points to somewhere: ``x``, or ``−y``."""
    for letter, points_to in zip("xyz", _AXES[axes], strict=True):
        if points_to == way:
            return letter
        if points_to == _OPPOSITE[way]:
            return f"−{letter}"
    raise ValueError(f"no axis of {axes} points to {way}, or away from it")
