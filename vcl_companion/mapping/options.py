"""How maps are made and when they are good enough to fly on (IV-C, IV-G)."""

from __future__ import annotations

from dataclasses import dataclass

from vcl_companion.mapping.keyframe_image import ImageFormat
from vcl_companion.options import require_positive
from vcl_companion.vision.av1_image import can_av1
from vcl_companion.vision.features import Detector

MOST_KEYFRAMES = 64
"""Of any map that is flown on: what is known of each is in every state of the filter."""
MOST_PIXELS = 80_000_000
"""Of all its images together: to be tracked they lie in memory, in all their sizes."""


@dataclass(frozen=True)
class MapOptions:
    """How a first map is made, and when it is good enough to fly on.

    Attributes:
        detectors: features that the map is made of; SIFT makes the better geometry
            from far apart, and those of the localization must be among them.
        image_format: in which images are exchanged; all read both. ``av1`` takes an OpenCV that
            writes it; ``webp`` 80 and 36 are as good as ``av1`` 60 and 40, and a quarter
            longer, of noisy images twice as long.
        keyframe_quality: of exchanged images, 1 to 100 of their format's own scale.
        update_quality: of those that extend a map: what they are for is found by its patches.
        update_features: images that extend a map keep their detail around so many of their
            strongest features and are blurred elsewhere (``vision.focus``).
        calibration_px: what each drone's lens may be off its calibration at the image's border,
            1 sigma: considered in all covariances; 0 for lenses that are exact, as rendered ones.
        min_landmarks: fewer are refused.
        min_angle_deg: landmarks seen under a smaller angle are left out.
        max_error_px: observations that miss by more are left out.
        attitude_sigma_deg: how far two autopilots' relative attitude may be off, 1 sigma.
        distance_sigma_m: how well the known distances are known, 1 sigma.
        max_depth_error: relative depth error, 1 sigma, median over the landmarks,
            above which the map is refused; twice that and a landmark is left out.
        patches: observations are measured again by patches; without, as the detectors say.
        landmarks_per_cell: of a map of patches, in each of 16 x 12 cells of an image.
        max_keyframes: an extended map keeps at most this many.
        max_landmarks: and at most this many landmarks.
        member_wait_s: how long a first map waits for members that are not there yet.
        gather_timeout_s: how long it waits for the frames of those that are.
        directory: where revisions are kept, and the map to begin with; empty for nowhere.
    """

    detectors: tuple[Detector, ...] = ("akaze", "sift")
    image_format: ImageFormat = "av1"
    keyframe_quality: int = 60
    update_quality: int = 40
    update_features: int = 1000
    calibration_px: float = 0.1
    min_landmarks: int = 60
    min_angle_deg: float = 1.0
    max_error_px: float = 2.5
    attitude_sigma_deg: float = 4.0
    distance_sigma_m: float = 0.01
    max_depth_error: float = 0.1
    patches: bool = True
    landmarks_per_cell: int = 4
    max_keyframes: int = 18
    max_landmarks: int = 12_000
    member_wait_s: float = 10.0
    gather_timeout_s: float = 20.0
    directory: str = ""

    def __post_init__(self) -> None:
        if len(set(self.detectors)) < len(self.detectors):
            raise ValueError(f"detectors: each once, got {list(self.detectors)}")
        if self.image_format == "av1" and not can_av1():
            raise ValueError(
                "image_format: this OpenCV writes no AV1 images; install opencv-python-headless "
                '4.12 or later, or set "webp" for the whole swarm'
            )
        for name in ("keyframe_quality", "update_quality"):
            if not 1 <= getattr(self, name) <= 100:
                raise ValueError(f"{name} must lie in 1..100, got {getattr(self, name)}")
        if not 100 <= self.update_features <= 20_000:
            raise ValueError(f"update_features must lie in 100..20000, got {self.update_features}")
        if not 0.0 <= self.calibration_px <= 10.0:
            raise ValueError(f"calibration_px must lie in 0..10, got {self.calibration_px}")
        if self.min_landmarks < 20:
            raise ValueError(f"min_landmarks must be at least 20, got {self.min_landmarks}")
        if self.landmarks_per_cell < 1:
            raise ValueError(f"landmarks_per_cell must be positive, got {self.landmarks_per_cell}")
        if not 4 <= self.max_keyframes <= MOST_KEYFRAMES:
            raise ValueError(
                f"max_keyframes must lie in 4..{MOST_KEYFRAMES}, got {self.max_keyframes}"
            )
        if not self.min_landmarks <= self.max_landmarks <= 16_000:
            raise ValueError(
                f"max_landmarks must lie in min_landmarks..16000, got {self.max_landmarks}"
            )
        require_positive(
            self,
            "min_angle_deg",
            "max_error_px",
            "attitude_sigma_deg",
            "distance_sigma_m",
            "max_depth_error",
            "member_wait_s",
            "gather_timeout_s",
        )


@dataclass(frozen=True)
class NoMap:
    """No map can be made of these views, and why."""

    reason: str
