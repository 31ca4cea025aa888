"""What one image says of where its drone is, and whether that is believed: a fix, or none.

Whoever finds a pose in an image, by features (``intra``) or by patches (``tracking``), says so in
these words, and has it judged here against its own uncertainty and the autopilot's attitude.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, euler_from_matrix
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.localization.localization_options import LocalizationOptions

# With so many landmarks a frame joins the map, though some are lost as its image is encoded: no
# single one decides where it was taken.
_JOINS = 50

Recognised = Literal["patches", "features", "odometry"]
"""What a pose rests on: the map's patches, a detector's features, or our own last frames alone."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Where the drone is expected: world_from_body and its (6, 6) local covariance."""

    world_from_body: Pose
    covariance: Array


@dataclass(frozen=True, eq=False)
class Localized:
    """A pose from one image.

    Attributes:
        world_from_body: the pose.
        noise_covariance: (6, 6) local, from this image's pixel noise; new in every frame.
        own_map_covariance: (6, 6) local, from the used landmarks' own errors and
            from how differently they look from here.
        map_lever: (6, 6V) local pose error per keyframe error of the map; by a map of own views
            (6, 6V + K), the last ones per what was expected wrongly of K parts' depths.
        keyframe_covariance: (6V, 6V) of those, or as much more.
        n_matched: landmarks matched.
        n_inliers: of these, how many agree.
        guided: whether the prediction led the matching.
        rms_px: of the inliers.
        n_seen: landmarks of the map that this image shows, as far as can be told.
        covered: share of the image that they fill, 0 to 1.
        by: what was recognised.
        novelty_deg: how differently they look from where they are remembered
            (``coverage.novelty_deg``); 0 where nobody has looked.
    """

    world_from_body: Pose
    noise_covariance: Array
    own_map_covariance: Array
    map_lever: Array
    keyframe_covariance: Array
    n_matched: int
    n_inliers: int
    guided: bool
    rms_px: float
    n_seen: int = 0
    covered: float = 0.0
    by: Recognised = "features"
    novelty_deg: float = 0.0

    @property
    def is_on_map(self) -> bool:
        """Whether it is the swarm's map that was recognised."""
        return self.by != "odometry"

    @property
    def shows_well(self) -> bool:
        """Whether the frame shows enough of the swarm's map to extend it by."""
        return self.is_on_map and self.n_inliers >= _JOINS

    def covariance(self) -> Array:
        """Return (6, 6) the whole covariance of this pose alone, local."""
        shared = self.map_lever @ self.keyframe_covariance @ self.map_lever.T
        return np.asarray(self.noise_covariance + self.own_map_covariance + shared)


@dataclass(frozen=True)
class NotLocalized:
    """No pose from this image, and why.

    Attributes:
        reason: for people.
        n_matched: landmarks matched.
        n_inliers: of these, how many agreed.
        vague: a pose that was found, not to be believed, good enough to look from.
    """

    reason: str
    n_matched: int = 0
    n_inliers: int = 0
    vague: Prior | None = field(default=None, compare=False)


def believed(
    fix: Localized, ned_from_body: Array | None, options: LocalizationOptions
) -> Localized | NotLocalized:
    """Return a pose only when it is certain enough and upright enough, else why not."""
    n_matched, n_inliers = fix.n_matched, fix.n_inliers
    covariance = fix.covariance()
    if not np.all(np.isfinite(covariance)):
        return NotLocalized("the landmarks found do not fix a pose", n_matched, n_inliers)
    sigma = worst_sigma(covariance[:3, :3])
    if sigma > options.max_sigma_m:
        return NotLocalized(
            f"too uncertain: {sigma:.1f} m, {options.max_sigma_m:.1f} m allowed",
            n_matched,
            n_inliers,
            Prior(fix.world_from_body, covariance),
        )
    if ned_from_body is not None:
        reason = disagreement(fix.world_from_body.rotation, ned_from_body, options)
        if reason:
            return NotLocalized(reason, n_matched, n_inliers)
    return fix


def disagreement(world_from_body: Array, ned_from_body: Array, options: LocalizationOptions) -> str:
    """Say how a rotation contradicts the autopilot's attitude; empty when it does not.

    Args:
        world_from_body: (3, 3) as an image says.
        ned_from_body: (3, 3) as the autopilot says.
        options: how much is too much.
    """
    tilt = np.rad2deg(np.arccos(np.clip(world_from_body[2] @ ned_from_body[2], -1.0, 1.0)))
    if tilt > options.max_tilt_deg:
        return f"disagrees with the autopilot's roll and pitch by {tilt:.0f} degrees"
    _, _, yaw = euler_from_matrix(world_from_body @ ned_from_body.T)
    heading = abs(np.rad2deg(yaw))
    if heading > options.max_heading_deg:
        return f"disagrees with the autopilot's heading by {heading:.0f} degrees"
    return ""
