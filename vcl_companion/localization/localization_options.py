"""When a pose is found in one image, by whatever it is recognised, and when it is believed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from vcl_companion.options import require_positive
from vcl_companion.vision.features import Detector


@dataclass(frozen=True)
class LocalizationOptions:
    """When a pose is found, and when it is believed.

    Attributes:
        detector: features to look for; must be among those the maps are built with.
        fallback_detector: looked for when a frame was not recognised by those; empty for none.
        min_inliers: landmarks that must agree on a pose.
        guided_radius_px: largest uncertainty of a prediction that still guides the matching.
        noise_floor_px: pixel noise is never taken for smaller than this, 1 sigma.
        bias_px_per_deg: misplacement of a feature per degree that the landmark is
            seen from another side than in its keyframe, 1 sigma.
        bias_px_per_octave: the same per doubling or halving of its distance.
        max_sigma_m: a pose less certain than this in any direction is refused.
        max_own_sigma_m: the same of a pose by the drone's own last frames, which is known among
            these far better: refused, they could not be gone on by until the map is there.
        max_tilt_deg: roll and pitch may disagree with the autopilot's by this much.
        max_heading_deg: heading may disagree with the autopilot's by this much.
    """

    detector: Detector = "akaze"
    fallback_detector: Literal["akaze", "sift", "orb", ""] = "sift"
    min_inliers: int = 15
    guided_radius_px: float = 40.0
    noise_floor_px: float = 0.4
    bias_px_per_deg: float = 0.03
    bias_px_per_octave: float = 1.5
    max_sigma_m: float = 1.0
    max_own_sigma_m: float = 5.0
    max_tilt_deg: float = 6.0
    max_heading_deg: float = 25.0

    def __post_init__(self) -> None:
        if self.min_inliers < 6:
            raise ValueError(f"min_inliers must be at least 6, got {self.min_inliers}")
        require_positive(
            self,
            "guided_radius_px",
            "noise_floor_px",
            "max_sigma_m",
            "max_own_sigma_m",
            "max_tilt_deg",
            "max_heading_deg",
            "bias_px_per_deg",
            "bias_px_per_octave",
        )

    def of_any_heading(self) -> LocalizationOptions:
        """Return the same where the autopilot's heading says nothing of the map's north."""
        return replace(self, max_heading_deg=180.0)

    def of_own_views(self) -> LocalizationOptions:
        """Return the same for poses by the drone's own last frames."""
        return replace(self, max_sigma_m=max(self.max_sigma_m, self.max_own_sigma_m))
