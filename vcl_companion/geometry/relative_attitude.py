"""How two cameras are turned to each other, by the attitudes that their autopilots say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, heading_of, log_so3


class Turned(Protocol):
    """A camera on a drone; see ``mapping.drone_view`` and ``localization.pair_evidence``."""

    @property
    def body_from_cam(self) -> Pose:
        """Its mounting."""

    @property
    def ned_from_body(self) -> Array | None:
        """(3, 3) attitude of the drone by its autopilot, or None."""

    @property
    def has_heading(self) -> bool:
        """Whether that attitude's heading is by the north of the others."""


@dataclass(frozen=True, eq=False)
class RelativeAttitude:
    """How two cameras are turned to each other.

    Attributes:
        ned_from_a: (3, 3) of the one camera.
        ned_from_b: (3, 3) of the other.
        has_heading: whether both are by one north; else only by one vertical.
    """

    ned_from_a: Array
    ned_from_b: Array
    has_heading: bool = True

    @property
    def b_from_a(self) -> Array | None:
        """(3, 3) the rotation; None without a heading."""
        return self.ned_from_b.T @ self.ned_from_a if self.has_heading else None

    def off_rad(self, b_from_a: Array) -> float:
        """Return by how much a (3, 3) rotation contradicts them."""
        off = self.ned_from_b @ b_from_a @ self.ned_from_a.T
        if not self.has_heading:
            off = about_down(-heading_of(off)) @ off
        return float(np.linalg.norm(log_so3(off)))


def relative_attitude(a: Turned, b: Turned) -> RelativeAttitude | None:
    """Return how two cameras are turned to each other; None where one has no attitude."""
    if a.ned_from_body is None or b.ned_from_body is None:
        return None
    return RelativeAttitude(
        a.ned_from_body @ a.body_from_cam.rotation,
        b.ned_from_body @ b.body_from_cam.rotation,
        a.has_heading and b.has_heading,
    )
