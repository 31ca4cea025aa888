"""Where one drone is, by one image's features and the map (intra-MAV localization, IV-D, IV-F)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.localization.coverage import covered_share
from vcl_companion.localization.feature_errors import bias_px, map_error
from vcl_companion.localization.fix import Localized, NotLocalized, Prior, believed
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.vision.features import Features
from vcl_companion.vision.matching import MatchOptions, match_guided, match_to_entries
from vcl_companion.vision.resection import (
    NotFound,
    Resection,
    ResectionOptions,
    Sightings,
    Undecided,
    refine,
    search,
    somewhere_alike,
)

_SURE_PX = 8.0
# One landmark may decide this much of a pose that a prediction led to, and of one found without:
# nothing else speaks for that one, and on few far landmarks it is metres off and sure of itself.
_LED_LEVERAGE, _FOUND_LEVERAGE = 0.4, 0.25
# Share of the matches near a right prediction that agree: 0.67 and more on every recording flown.
# Near a wrong one repeated structure (windows) agreed on a pose 6 m off with a half.
_LED_SHARE = 0.6
# A landmark's depth is so many sigmas at least.
_SURELY = 3.0
# A pose that rests on single landmarks is taken to be off by so many times what it says.
_UNDECIDED = 3.0


@dataclass(frozen=True, eq=False)
class _Matched:
    """One attempt: the matches it made, and what came of them."""

    landmarks: NDArray[np.intp]
    pixels: Array
    result: Resection | NotFound

    @property
    def agreeing_share(self) -> float:
        """Share of the matches that agree on the pose; 0 without one."""
        return float(self.result.inliers.mean()) if isinstance(self.result, Resection) else 0.0


def localize_intra(
    features: Features,
    camera: Camera,
    body_from_cam: Pose,
    index: MapIndex,
    prior: Prior | None,
    ned_from_body: Array | None,
    options: LocalizationOptions,
) -> Localized | NotLocalized:
    """Find the drone's pose in the map.

    A good prediction guides the matching; without one, or where it misleads (no
    pose, or many of the matches near it against it), the whole map is searched. A
    pose found is used once more to match what the first round missed.

    Args:
        features: of the image.
        camera: its intrinsics.
        body_from_cam: its mounting.
        index: the current map.
        prior: where the drone is expected, or None.
        ned_from_body: (3, 3) attitude by the autopilot at that instant, or None.
        options: thresholds.

    Returns:
        The pose with its covariance in two parts, or why there is none.
    """
    scene = _Matcher(features, camera, body_from_cam, index, options)
    attempt = None
    guided = False
    radius_px = float("inf") if prior is None else scene.radius_px(prior)
    if prior is not None and radius_px <= options.guided_radius_px:
        attempt = scene.guided(prior.world_from_body, max(radius_px, _SURE_PX), _LED_LEVERAGE)
        guided = attempt.agreeing_share >= _LED_SHARE
    if attempt is None or not guided:
        attempt = scene.whole_map()
    # Matched from nearby already, a second round would find the same again.
    first = attempt.result
    if isinstance(first, Resection) and not (guided and radius_px <= 2.0 * _SURE_PX):
        limit = _LED_LEVERAGE if guided else _FOUND_LEVERAGE
        again = scene.guided(first.world_from_body, _SURE_PX, limit)
        if isinstance(again.result, Resection):
            alike = somewhere_alike(again.result, _SURE_PX)
            if alike is not None:
                attempt = replace(attempt, result=alike)
            elif again.result.inliers.sum() >= first.inliers.sum():
                attempt = again
    return scene.judged(attempt, guided, ned_from_body)


@dataclass(frozen=True, eq=False)
class _Matcher:
    """One image against one map."""

    features: Features
    camera: Camera
    body_from_cam: Pose
    index: MapIndex
    options: LocalizationOptions

    def radius_px(self, prior: Prior) -> float:
        """Return 3 sigma of where landmarks will appear, px, for the nearest quarter of them."""
        points_cam = (
            (prior.world_from_body @ self.body_from_cam)
            .inverse()
            .apply(self.index.landmark_map.points_world)
        )
        z = points_cam[points_cam[:, 2] > 0.1, 2]
        if len(z) == 0:
            return float("inf")
        depth = float(np.quantile(z, 0.25))
        sigma_m = worst_sigma(prior.covariance[:3, :3])
        sigma_rad = worst_sigma(prior.covariance[3:, 3:])
        return 3.0 * self.camera.focal_px * float(np.hypot(sigma_m / depth, sigma_rad))

    def guided(self, world_from_body: Pose, radius_px: float, max_leverage: float) -> _Matched:
        """Match near where the pose puts each landmark, then refine from that pose."""
        cam_from_world = (world_from_body @ self.body_from_cam).inverse()
        predicted = self.camera.project(cam_from_world.apply(self.index.landmark_map.points_world))
        with np.errstate(invalid="ignore"):
            outside = (
                (predicted < -radius_px).any(axis=1)
                | (predicted[:, 0] > self.camera.width_px + radius_px)
                | (predicted[:, 1] > self.camera.height_px + radius_px)
            )
        predicted[outside] = np.nan
        found, landmarks = match_guided(
            self.features,
            self.index.entries,
            self.index.owner,
            predicted,
            radius_px,
            MatchOptions(),
        )
        sightings = self._sightings(found, landmarks, world_from_body)
        start: Pose | NotFound = world_from_body
        if radius_px > _SURE_PX:
            start = search(sightings, self._resection_options(max_leverage))
        return self._refined(start, found, landmarks, sightings, max_leverage)

    def whole_map(self) -> _Matched:
        """Match against every landmark, then search the pose among the matches."""
        found, landmarks = match_to_entries(
            self.features,
            self.index.entries,
            self.index.owner,
            MatchOptions(),
            self.index.search,
        )
        sightings = self._sightings(found, landmarks, None)
        start = search(sightings, self._resection_options(_FOUND_LEVERAGE))
        return self._refined(start, found, landmarks, sightings, _FOUND_LEVERAGE)

    def judged(
        self, attempt: _Matched, guided: bool, ned_from_body: Array | None
    ) -> Localized | NotLocalized:
        """Say how certain the pose is, and whether it is believed."""
        n_matched = len(attempt.landmarks)
        if isinstance(attempt.result, Undecided):
            vague = self._fix(attempt, attempt.result.found, guided)
            widened = _UNDECIDED**2 * vague.covariance()
            led = Prior(vague.world_from_body, widened) if np.all(np.isfinite(widened)) else None
            return NotLocalized(attempt.result.reason, n_matched, vague=led)
        if isinstance(attempt.result, NotFound):
            return NotLocalized(attempt.result.reason, n_matched)
        return believed(self._fix(attempt, attempt.result, guided), ned_from_body, self.options)

    def _fix(self, attempt: _Matched, result: Resection, guided: bool) -> Localized:
        n_matched, n_inliers = len(attempt.landmarks), int(result.inliers.sum())
        landmarks, pixels = attempt.landmarks[result.inliers], attempt.pixels[result.inliers]
        uncertainty = self.index.uncertainty
        own, lever = map_error(result, landmarks, pixels, self.camera, uncertainty)
        return Localized(
            result.world_from_body,
            result.noise_covariance,
            own,
            lever,
            uncertainty.keyframe_covariance,
            n_matched,
            n_inliers,
            guided,
            result.rms_px,
            n_inliers,
            covered_share(pixels, self.camera),
        )

    def _sightings(
        self,
        found: NDArray[np.intp],
        landmarks: NDArray[np.intp],
        world_from_body: Pose | None,
    ) -> Sightings:
        landmark_map = self.index.landmark_map
        misplaced_px = np.zeros(len(landmarks))
        if world_from_body is not None:
            centre = (world_from_body @ self.body_from_cam).translation
            misplaced_px = bias_px(landmark_map, landmarks, centre, self.options)
        ideal = self.camera.ideal_from_pixels(self.features.pixels[found])
        return Sightings(
            ideal,
            landmark_map.points_world[landmarks],
            self.index.landmark_covariances[landmarks],
            self.camera.focal_px,
            self.camera.pixel_slopes(ideal),
            self.body_from_cam,
            max(self.options.noise_floor_px, landmark_map.pixel_noise_px),
            misplaced_px,
        )

    def _in_front(self, world_from_body: Pose, landmarks: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return (M,) which landmarks are surely in front of the camera.

        One that may lie at its very lens may appear anywhere: whatever it was matched to agrees.
        """
        world_from_cam = world_from_body @ self.body_from_cam
        axis = world_from_cam.rotation[:, 2]
        points = self.index.landmark_map.points_world[landmarks]
        own = self.index.uncertainty.landmark_covariance[landmarks]
        depth_m = (points - world_from_cam.translation) @ axis
        return np.asarray(depth_m > _SURELY * np.sqrt(np.einsum("i,mij,j->m", axis, own, axis)))

    def _resection_options(self, max_leverage: float) -> ResectionOptions:
        return ResectionOptions(self.options.min_inliers, max_leverage=max_leverage)

    def _refined(
        self,
        start: Pose | NotFound,
        found: NDArray[np.intp],
        landmarks: NDArray[np.intp],
        sightings: Sightings,
        max_leverage: float,
    ) -> _Matched:
        pixels = self.features.pixels[found]
        if isinstance(start, NotFound):
            return _Matched(landmarks, pixels, start)
        seen = np.where(self._in_front(start, landmarks)[:, None], sightings.ideal, np.nan)
        sightings = replace(sightings, ideal=seen)
        result = refine(start, sightings, self._resection_options(max_leverage))
        return _Matched(landmarks, pixels, result)
