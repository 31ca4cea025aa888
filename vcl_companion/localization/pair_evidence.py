"""What two drones' images say of the second one's pose: landmarks, epipolar lines, attitudes.

Where the common landmarks appear in the target's image carries the scale; the
epipolar lines of all other matches, and the autopilots' roll, pitch and
heading, hold what a small patch of landmarks leaves open.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, heading_of, log_so3, skew
from vcl_companion.localization.jackknife import jackknife, no_less_than
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.mapping.lens_errors import lens_px
from vcl_companion.options import require_positive
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.epipolar import signed_sampson
from vcl_companion.vision.features import Features
from vcl_companion.vision.information import covariance_of

_STEP = 1e-6
_NUDGES = _STEP * np.eye(6)
# One match may decide this much of the pose.
_MAX_LEVERAGE = 0.4
# Without so many common landmarks there is no scale.
_LEAST_LANDMARKS = 4
# Smallest eigenvalue of a normal matrix, scaled to a diagonal of ones, that is no rounding.
_SINGULAR = 1e-9
# Normalised squares beyond these are no noise: 3 sigma, 99.9 % of chi^2 with 2 and with 3
# degrees of freedom.
_EPIPOLAR, _LANDMARK, _ATTITUDE = 9.0, 13.8, 16.3


@dataclass(frozen=True)
class InterOptions:
    """When a relative pose is believed.

    Attributes:
        min_matches: matches between the two images that must agree.
        min_common: landmarks of the map among them, for the scale.
        max_scale_spread: relative spread (1 sigma) of the scale over them.
        attitude_sigma_deg: how far the two autopilots' headings may be off against each
            other, 1 sigma.
        tilt_sigma_deg: the same of their roll and pitch, which gravity holds.
        noise_floor_px: pixel noise is never taken for smaller than this, 1 sigma.
        bias_px_per_deg: misplacement of a feature per degree of parallax, 1 sigma.
        max_sigma_m: a proposal less certain than this is not made.
    """

    min_matches: int = 30
    min_common: int = 8
    max_scale_spread: float = 0.3
    attitude_sigma_deg: float = 4.0
    tilt_sigma_deg: float = 1.5
    noise_floor_px: float = 0.4
    bias_px_per_deg: float = 0.03
    max_sigma_m: float = 2.0

    def __post_init__(self) -> None:
        if self.min_matches < 12 or self.min_common < 4:
            raise ValueError("inter-MAV needs min_matches >= 12 and min_common >= 4")
        require_positive(
            self,
            "max_scale_spread",
            "attitude_sigma_deg",
            "tilt_sigma_deg",
            "noise_floor_px",
            "bias_px_per_deg",
            "max_sigma_m",
        )


@dataclass(frozen=True, eq=False)
class Observer:
    """One drone's image of the instant.

    Attributes:
        features: of the image.
        camera: its intrinsics.
        body_from_cam: its mounting.
        ned_from_body: (3, 3) attitude by its autopilot, or None.
        has_heading: whether its heading is by the other's north; else only roll and pitch count.
    """

    features: Features
    camera: Camera
    body_from_cam: Pose
    ned_from_body: Array | None
    has_heading: bool = True


@dataclass(frozen=True, eq=False)
class Agreement:
    """(M,) bool each: matches that count by their epipolar line, and by their landmark."""

    epipolar: NDArray[np.bool_]
    landmark: NDArray[np.bool_]

    def among(self, kept: NDArray[np.bool_]) -> Agreement:
        """Return those among some."""
        return Agreement(self.epipolar & kept, self.landmark & kept)

    def same(self, other: Agreement) -> bool:
        """Return whether the same matches agree."""
        return np.array_equal(self.epipolar, other.epipolar) and np.array_equal(
            self.landmark, other.landmark
        )


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """What the matches of two images say of the target's pose; M of them.

    Attributes:
        host: one image.
        target: the other.
        host_pose: world_from_body of the host.
        index: the map.
        ideal_host: (M, 2) ideal image coordinates in the host's image.
        ideal_target: (M, 2) likewise in the target's.
        focal_px: px per ideal unit, for epipolar distances.
        landmarks: (M,) landmark of the map behind each match, -1 for none.
        expected_rotation: the target's world_from_body (3, 3) by the autopilots, or None.
        options: how far each may be off.
    """

    host: Observer
    target: Observer
    host_pose: Pose
    index: MapIndex
    ideal_host: Array
    ideal_target: Array
    focal_px: float
    landmarks: NDArray[np.intp]
    expected_rotation: Array | None
    options: InterOptions

    def known(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return those of the chosen matches that have a landmark."""
        return np.asarray(chosen & (self.landmarks >= 0))

    def agreeing(self, pose: Pose) -> Agreement:
        """Return who agrees with a pose; a match off its landmark may still lie on its line."""
        on_line = self._line_squares(pose) < _EPIPOLAR
        landmark = self.known(on_line)
        landmark[landmark] = self._landmark_squares(pose, landmark) < _LANDMARK
        return Agreement(on_line & ~landmark, landmark)

    def cost(self, pose: Pose) -> float:
        """Return the truncated squares of all evidence, the same evidence for every pose."""
        epipolar = self._line_squares(pose)
        everyone = np.ones(len(self.landmarks), dtype=np.bool_)
        landmark = self._landmark_squares(pose, self.known(everyone))
        cost = float(np.minimum(epipolar, _EPIPOLAR).sum())
        cost += float(np.minimum(landmark, _LANDMARK).sum())
        attitude = self._attitude(pose)
        if attitude is not None:
            off, information = attitude
            cost += min(float(off @ information @ off), _ATTITUDE)
        return cost

    def refined(self, start: Pose, chosen: Agreement) -> Pose:
        """Return the pose of least squares over the matches that agree, from one nearby."""
        pose = start
        for _ in range(8):
            normal, rhs = self._system(pose, chosen)
            step = np.asarray(np.linalg.lstsq(normal, rhs, rcond=1e-12)[0], dtype=np.float64)
            if not np.all(np.isfinite(step)) or np.linalg.norm(step) > 10.0:
                return start
            pose = pose.retracted(step)
            if np.linalg.norm(step) < 1e-8:
                break
        return pose

    def covariance(self, pose: Pose, chosen: Agreement, host_covariance: Array) -> Array:
        """Return (6, 6) of the target's pose: pixels, landmarks, the host's own error (eq. 9).

        No smaller than what the pose shows without parts of the target's image (``jackknife``).
        Infinite where the matches do not fix it.
        """
        normal, _ = self._system(pose, chosen)
        inverse = covariance_of(normal, _SINGULAR)
        if inverse is None:
            return np.full((6, 6), np.inf)
        through = -inverse @ self._by_host(pose, chosen)
        shared, by_lens = (-inverse @ by for by in self._by_map_and_lens(pose, chosen))
        keyframes = self.index.uncertainty.keyframe_covariance
        of_matches = no_less_than(
            inverse + shared @ keyframes @ shared.T + by_lens @ by_lens.T,
            self._jackknife(pose, chosen),
        )
        return np.asarray(of_matches + through @ host_covariance @ through.T)

    def _jackknife(self, pose: Pose, chosen: Agreement) -> Array:
        def without(kept: NDArray[np.bool_]) -> Pose | None:
            agreeing = chosen.among(kept)
            if agreeing.landmark.sum() < _LEAST_LANDMARKS:
                return None
            moved = self.refined(pose, agreeing)
            return self.refined(moved, self.agreeing(moved).among(kept))

        used = chosen.epipolar | chosen.landmark
        return jackknife(pose, self.ideal_target, used, without)

    def undecisive(self, pose: Pose, chosen: Agreement) -> Agreement:
        """Return those that agree without the ones that nearly decide the pose alone.

        Such a one agrees with whatever pose it leads to: nothing checks its word.
        """
        normal, _ = self._system(pose, chosen)
        inverse = covariance_of(normal, _SINGULAR)
        if inverse is None:
            return chosen
        sigma_px = self._sigma_px(pose)
        _, by_pose, weight = self._lines(pose, chosen.epipolar, sigma_px)
        on_line = np.einsum("ni,ij,nj->n", by_pose, inverse, by_pose) * weight
        residual, information, j_pose, _ = self._sightings(pose, chosen.landmark, sigma_px)
        squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
        in_place = np.einsum("nki,ij,nlj,nkl->n", j_pose, inverse, j_pose, information)
        epipolar, landmark = chosen.epipolar.copy(), chosen.landmark.copy()
        epipolar[epipolar] = on_line <= _MAX_LEVERAGE
        landmark[landmark] = in_place * _weight(squared) <= _MAX_LEVERAGE
        return Agreement(epipolar, landmark)

    def _system(self, pose: Pose, chosen: Agreement) -> tuple[Array, Array]:
        """Return normal matrix and right side of the pose."""
        sigma_px = self._sigma_px(pose)
        weighted, residual, j_pose, _ = self._places(pose, chosen.landmark, sigma_px)
        normal = np.einsum("nik,nkj->ij", weighted, j_pose)
        rhs = -np.einsum("nik,nk->i", weighted, residual)
        error, by_pose, weight = self._lines(pose, chosen.epipolar, sigma_px)
        normal += (by_pose * weight[:, None]).T @ by_pose
        rhs -= (by_pose * weight[:, None]).T @ error
        attitude = self._attitude(pose)
        if attitude is not None:
            off, information = attitude
            information = information / (1.0 + float(off @ information @ off) / _ATTITUDE) ** 2
            normal[3:, 3:] += information
            rhs[3:] -= information @ off
        return normal, rhs

    def _by_host(self, pose: Pose, chosen: Agreement) -> Array:
        """Return (6, 6) how the right side goes with the host's pose, by its epipolar lines."""
        error, by_pose, weight = self._lines(pose, chosen.epipolar, self._sigma_px(pose))
        hosts = [self.host_pose.retracted(nudge) for nudge in _NUDGES]
        moved = self._epipolar_px([self._target_from_host(pose, h) for h in hosts], chosen.epipolar)
        return np.asarray((by_pose * weight[:, None]).T @ ((moved - error) / _STEP).T)

    def _by_map_and_lens(self, pose: Pose, chosen: Agreement) -> tuple[Array, Array]:
        """Return how the right side goes, by its landmarks, with what these are found by.

        Returns:
            (6, 6V) with the map's keyframes, and (6, 7) with the target's lens.
        """
        of_landmarks, uncertainty = chosen.landmark, self.index.uncertainty
        weighted, _, _, j_point = self._places(pose, of_landmarks, self._sigma_px(pose))
        levers = uncertainty.landmark_lever[self.landmarks[of_landmarks]]
        camera = self.target.camera
        pixels = camera.pixels_from_ideal(self.ideal_target[of_landmarks])
        off_px = lens_px(camera, pixels, uncertainty.calibration_px)
        return (
            np.asarray(np.tensordot(weighted @ j_point, levers, axes=((0, 2), (0, 1)))),
            np.asarray(np.tensordot(weighted, off_px, axes=((0, 2), (0, 1)))),
        )

    def _lines(
        self, pose: Pose, chosen: NDArray[np.bool_], sigma_px: Array
    ) -> tuple[Array, Array, Array]:
        """Return how far off their lines (K,) matches are, slopes by pose (K, 6), weights (K,)."""
        poses = [pose, *(pose.retracted(nudge) for nudge in _NUDGES)]
        errors = self._epipolar_px([self._target_from_host(p) for p in poses], chosen)
        error, sigma = errors[0], sigma_px[chosen]
        by_pose = ((errors[1:] - error) / _STEP).T
        return error, by_pose, _weight((error / sigma) ** 2) / sigma**2

    def _attitude(self, pose: Pose) -> tuple[Array, Array] | None:
        """Return (3,) how far the rotation is off the autopilots', body axes, and its weight."""
        if self.expected_rotation is None:
            return None
        tilt, heading = np.deg2rad([self.options.tilt_sigma_deg, self.options.attitude_sigma_deg])
        in_world = np.diag(1.0 / np.array([tilt, tilt, heading]) ** 2)
        expected = self.expected_rotation
        if not (self.host.has_heading and self.target.has_heading):
            in_world[2, 2] = 0.0
            expected = about_down(heading_of(pose.rotation @ expected.T)) @ expected
        off = log_so3(expected.T @ pose.rotation)
        return off, np.asarray(pose.rotation.T @ in_world @ pose.rotation)

    def _sigma_px(self, pose: Pose) -> Array:
        """Return (M,) how far a feature may lie beside its place, 1 sigma."""
        turn_deg = np.rad2deg(
            _parallax(self._target_from_host(pose), self.ideal_host, self.ideal_target)
        )
        return np.hypot(self.options.noise_floor_px, self.options.bias_px_per_deg * turn_deg)

    def _line_squares(self, pose: Pose) -> Array:
        """Return (M,) squared distances of all matches from their epipolar lines, in noise."""
        everyone = np.ones(len(self.landmarks), dtype=np.bool_)
        distance_px = self._epipolar_px([self._target_from_host(pose)], everyone)[0]
        return np.asarray((distance_px / self.options.noise_floor_px) ** 2)

    def _landmark_squares(self, pose: Pose, chosen: NDArray[np.bool_]) -> Array:
        """Return (K,) squared normalised errors of landmarks in the target's image."""
        residual, information, _, _ = self._sightings(pose, chosen, self._sigma_px(pose))
        return np.asarray(np.einsum("nk,nkl,nl->n", residual, information, residual))

    def _sightings(
        self, pose: Pose, chosen: NDArray[np.bool_], sigma_px: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return residual (K, 2), its information, and slopes by pose and point."""
        landmarks = self.landmarks[chosen]
        ideal = self.ideal_target[chosen]
        residual, j_pose, j_point = linearized(
            pose,
            self.target.body_from_cam,
            self.target.camera.pixel_slopes(ideal),
            self.index.landmark_map.points_world[landmarks],
            ideal,
        )
        own = self.index.uncertainty.landmark_covariance[landmarks]
        covariance = j_point @ own @ np.swapaxes(j_point, 1, 2)
        covariance[:, [0, 1], [0, 1]] += sigma_px[chosen, None] ** 2
        return residual, np.asarray(np.linalg.inv(covariance)), j_pose, j_point

    def _places(
        self, pose: Pose, chosen: NDArray[np.bool_], sigma_px: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return where landmarks appear in the target's image, weighed.

        Returns:
            (K, 6, 2) slopes by the pose times information and robust weight; residuals (K, 2)
            and their slopes by pose (K, 2, 6) and point (K, 2, 3).
        """
        residual, information, j_pose, j_point = self._sightings(pose, chosen, sigma_px)
        squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
        weighted = np.swapaxes(j_pose, 1, 2) @ information
        weighted *= _weight(squared)[:, None, None]
        return weighted, residual, j_pose, j_point

    def _target_from_host(self, pose: Pose, host_pose: Pose | None = None) -> Pose:
        world_from_host = (host_pose or self.host_pose) @ self.host.body_from_cam
        return (pose @ self.target.body_from_cam).inverse() @ world_from_host

    def _epipolar_px(self, targets_from_hosts: list[Pose], chosen: NDArray[np.bool_]) -> Array:
        """Return (P, K) signed distances from the epipolar lines by P relative poses, px."""
        essentials = np.stack([_essential(pose) for pose in targets_from_hosts])
        a, b = self.ideal_host[chosen], self.ideal_target[chosen]
        return signed_sampson(essentials, a, b, self.focal_px)


def _essential(b_from_a: Pose) -> Array:
    length = max(float(np.linalg.norm(b_from_a.translation)), 1e-9)
    return np.asarray(skew(b_from_a.translation / length) @ b_from_a.rotation)


def _weight(squared: Array) -> Array:
    """Return what a match counts whose normalised error squared is this (Geman-McClure)."""
    return np.asarray(1.0 / (1.0 + squared / 4.0) ** 2)


def _parallax(target_from_host: Pose, ideal_host: Array, ideal_target: Array) -> Array:
    """Return (M,) angle under which the two cameras see each match, rad."""
    rays_host = np.hstack([ideal_host, np.ones((len(ideal_host), 1))]) @ target_from_host.rotation.T
    rays_target = np.hstack([ideal_target, np.ones((len(ideal_target), 1))])
    cosine = np.einsum("ni,ni->n", rays_host, rays_target) / (
        np.linalg.norm(rays_host, axis=1) * np.linalg.norm(rays_target, axis=1)
    )
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
