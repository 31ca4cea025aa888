"""Where one drone is, seen from another (inter-MAV localization, IV-E, Algorithm 1, eqs. 8, 9).

The host knows its own pose in the map. Its image and the target's of the same
instant give the target's pose relative to it, up to scale; landmarks of the map
that both images show give the scale. What the host then proposes to the target
is only as good as the host, the relative pose and the map together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, log_so3
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.essential import (
    EssentialOptions,
    RelativePose,
    relative_poses,
    sampson_px,
)
from vcl_companion.vision.features import Features
from vcl_companion.vision.information import covariance_of
from vcl_companion.vision.matching import MatchOptions, match_mutual, match_to_entries
from vcl_companion.vision.triangulation import triangulate

_STEP = 1e-6
_SAME_LANDMARK_PX = 3.0
# Smallest eigenvalue of a normal matrix, scaled to a diagonal of ones, that is no rounding.
_SINGULAR = 1e-9
# A hypothesis that costs this much more is e^-10 times as likely.
_RIVAL_COST = 20.0


@dataclass(frozen=True)
class InterOptions:
    """When a relative pose is believed.

    Attributes:
        min_matches: matches between the two images that must agree.
        min_common: landmarks of the map among them, for the scale.
        max_scale_spread: relative spread (1 sigma) of the scale over them.
        attitude_sigma_deg: how far the two autopilots' relative attitude may be off, 1 sigma.
        noise_floor_px: pixel noise is never taken for smaller than this, 1 sigma.
        bias_px_per_deg: misplacement of a feature per degree of parallax, 1 sigma.
        max_sigma_m: a proposal less certain than this is not made.
    """

    min_matches: int = 30
    min_common: int = 8
    max_scale_spread: float = 0.3
    attitude_sigma_deg: float = 4.0
    noise_floor_px: float = 0.5
    bias_px_per_deg: float = 0.03
    max_sigma_m: float = 2.0

    def __post_init__(self) -> None:
        if self.min_matches < 12 or self.min_common < 4:
            raise ValueError("inter-MAV needs min_matches >= 12 and min_common >= 4")
        for name in (
            "max_scale_spread",
            "attitude_sigma_deg",
            "noise_floor_px",
            "bias_px_per_deg",
            "max_sigma_m",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Observer:
    """One drone's image of the instant.

    Attributes:
        features: of the image.
        camera: its intrinsics.
        body_from_cam: its mounting.
        ned_from_body: (3, 3) attitude by its autopilot, or None.
    """

    features: Features
    camera: Camera
    body_from_cam: Pose
    ned_from_body: Array | None


@dataclass(frozen=True, eq=False)
class Proposal:
    """Where the host says that the target is.

    Attributes:
        world_from_body: the target's pose.
        covariance: (6, 6) local perturbation: host, relative pose and scale.
        n_matches: matches that agree.
        n_common: landmarks behind the scale.
    """

    world_from_body: Pose
    covariance: Array
    n_matches: int
    n_common: int


@dataclass(frozen=True)
class NoProposal:
    """The host cannot tell where the target is, and why."""

    reason: str


def localize_inter(
    host: Observer,
    host_pose: Pose,
    host_covariance: Array,
    target: Observer,
    index: MapIndex,
    options: InterOptions,
    seed: int = 0,
) -> Proposal | NoProposal:
    """Find the target's pose from the host's.

    Args:
        host: the drone that knows where it is.
        host_pose: world_from_body of the host at that instant.
        host_covariance: (6, 6) local, the map's error in it.
        target: the drone that asks.
        index: the host's map.
        options: thresholds.
        seed: of the robust search.

    Returns:
        A proposal with its covariance, or why there is none. Without enough
        common landmarks there is no scale, and so no proposal.
    """
    i, k = match_mutual(host.features, target.features, MatchOptions())
    ideal_host = host.camera.ideal_from_pixels(host.features.pixels[i])
    ideal_target = target.camera.ideal_from_pixels(target.features.pixels[k])
    focal_px = 0.5 * (host.camera.focal_px + target.camera.focal_px)
    guess = _rotation_guess(host, target)
    hypotheses = relative_poses(ideal_host, ideal_target, focal_px, guess, EssentialOptions(), seed)
    hypotheses = [h for h in hypotheses if h.inliers.sum() >= options.min_matches]
    if not hypotheses:
        return NoProposal(f"too little in common with the host ({len(i)} matches)")
    pair = _Pair(
        host,
        target,
        index,
        ideal_host,
        ideal_target,
        focal_px,
        _landmarks_of(host, host_pose, index, i),
        options,
    )
    judged = [pair.placed(h, host_pose, guess) for h in hypotheses]
    usable = [s for s in judged if isinstance(s, _Placed)]
    if not usable:
        return next(s for s in judged if isinstance(s, NoProposal))
    # By the total cost over all matches, never by the smallest sigma: that chooses
    # the planar twin.
    best = min(usable, key=lambda s: s.cost)
    rivals = [s for s in usable if s.cost - best.cost < _RIVAL_COST]
    covariance = pair.covariance(best, host_pose, host_covariance)
    if not np.all(np.isfinite(covariance)):
        return NoProposal("what both see does not fix the target's pose")
    covariance = covariance + _spread(best, rivals)
    covariance = 0.5 * (covariance + covariance.T)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    if not sigma_m <= options.max_sigma_m:
        return NoProposal(f"too uncertain: {sigma_m:.2f} m, {options.max_sigma_m:.2f} m allowed")
    return Proposal(best.world_from_body, covariance, best.n_matches, best.n_common)


@dataclass(frozen=True, eq=False)
class _Placed:
    """A hypothesis in the world: the target's pose, what it costs, and who supports it."""

    world_from_body: Pose
    cost: float
    agree: NDArray[np.bool_]
    n_matches: int
    n_common: int


def _spread(best: _Placed, rivals: list[_Placed]) -> Array:
    """Return (6, 6) how far apart hypotheses are that explain the matches nearly as well.

    With few matches the cost has several minima close to each other, and the
    slope at one of them knows nothing of the next.
    """
    spread = np.zeros((6, 6))
    total = 0.0
    for rival in rivals:
        weight = float(np.exp(-0.5 * (rival.cost - best.cost)))
        off = best.world_from_body.local(rival.world_from_body)
        spread += weight * np.outer(off, off)
        total += weight
    return spread / total


def _rotation_guess(host: Observer, target: Observer) -> Array | None:
    """Return camera target_from_host (3, 3) by the two autopilots."""
    if host.ned_from_body is None or target.ned_from_body is None:
        return None
    ned_from_target = target.ned_from_body @ target.body_from_cam.rotation
    return np.asarray(ned_from_target.T @ host.ned_from_body @ host.body_from_cam.rotation)


def _landmarks_of(
    host: Observer, host_pose: Pose, index: MapIndex, chosen: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return (M,) the landmark of the map behind each match, by the host's feature; -1 without."""
    found, landmarks = match_to_entries(host.features, index.entries, index.owner, MatchOptions())
    cam_from_world = (host_pose @ host.body_from_cam).inverse()
    points_cam = cam_from_world.apply(index.landmark_map.points_world[landmarks])
    error = np.linalg.norm(host.camera.project(points_cam) - host.features.pixels[found], axis=1)
    out = np.full(len(host.features), -1, dtype=np.intp)
    near = error < _SAME_LANDMARK_PX
    out[found[near]] = landmarks[near]
    return np.asarray(out[chosen])


@dataclass(frozen=True, eq=False)
class _Pair:
    """The matches of two images, some of them with a landmark of the map."""

    host: Observer
    target: Observer
    index: MapIndex
    ideal_host: Array
    ideal_target: Array
    focal_px: float
    landmarks: NDArray[np.intp]
    options: InterOptions

    def placed(
        self, hypothesis: RelativePose, host_pose: Pose, guess: Array | None
    ) -> _Placed | NoProposal:
        """Give a hypothesis its scale and refine it over all that agrees with it.

        The scale begins as the ratio of depths in the map and at baseline 1. The
        refinement then weighs both kinds of evidence together: where the common
        landmarks appear in the target's image, and the epipolar lines of all
        other matches.
        """
        agree = hypothesis.inliers
        cams = [Pose.identity(), hypothesis.b_from_a.inverse()]
        rays = np.stack([self.ideal_host[agree], self.ideal_target[agree]], axis=1)
        points = triangulate(cams, rays)
        known = self.landmarks[agree] >= 0
        world_from_cam = host_pose @ self.host.body_from_cam
        in_map = self.index.landmark_map.points_world[self.landmarks[agree][known]]
        with np.errstate(invalid="ignore", divide="ignore"):
            log_ratio = np.log(world_from_cam.inverse().apply(in_map)[:, 2] / points[known, 2])
        log_ratio = log_ratio[np.isfinite(log_ratio)]
        least = self.options.min_common
        if len(log_ratio) < least:
            return NoProposal(
                f"{len(log_ratio)} landmarks in common with the host, {least} needed for the scale"
            )
        middle = float(np.median(log_ratio))
        spread = 1.4826 * float(np.median(np.abs(log_ratio - middle)))
        if spread > self.options.max_scale_spread:
            return NoProposal(
                f"the scale varies by {100 * spread:.0f} % over the common landmarks, "
                f"{100 * self.options.max_scale_spread:.0f} % allowed"
            )
        unit = hypothesis.b_from_a
        target_from_host = Pose(unit.rotation, np.exp(middle) * unit.translation)
        start = world_from_cam @ target_from_host.inverse() @ self.target.body_from_cam.inverse()
        pose = self._refined(start, host_pose, agree)
        cost = hypothesis.cost
        if guess is not None:
            off = float(np.linalg.norm(log_so3(guess.T @ unit.rotation)))
            cost += (off / np.deg2rad(self.options.attitude_sigma_deg)) ** 2
        return _Placed(pose, cost, agree, int(agree.sum()), int(known.sum()))

    def covariance(self, placed: _Placed, host_pose: Pose, host_covariance: Array) -> Array:
        """Return (6, 6) of the target's pose: pixels, landmarks, the host's own error (eq. 9).

        Infinite where the matches do not fix it.
        """
        normal, _, by_host, lever = self._system(placed.world_from_body, host_pose, placed.agree)
        inverse = covariance_of(normal, _SINGULAR)
        if inverse is None:
            return np.full((6, 6), np.inf)
        through = -inverse @ by_host
        shared = -inverse @ lever
        keyframes = self.index.uncertainty.keyframe_covariance
        return np.asarray(
            inverse + through @ host_covariance @ through.T + shared @ keyframes @ shared.T
        )

    def _refined(self, start: Pose, host_pose: Pose, agree: NDArray[np.bool_]) -> Pose:
        pose = start
        for _ in range(8):
            normal, rhs, _, _ = self._system(pose, host_pose, agree)
            step = np.asarray(np.linalg.lstsq(normal, rhs, rcond=1e-12)[0], dtype=np.float64)
            if not np.all(np.isfinite(step)) or np.linalg.norm(step) > 10.0:
                return start
            pose = pose.retracted(step)
            if np.linalg.norm(step) < 1e-8:
                break
        return pose

    def _system(
        self, pose: Pose, host_pose: Pose, agree: NDArray[np.bool_]
    ) -> tuple[Array, Array, Array, Array]:
        """Return normal matrix, right side, its slopes by host (6, 6) and keyframes (6, 6V)."""
        turn_deg = np.rad2deg(
            _parallax(self._target_from_host(pose, host_pose), self.ideal_host, self.ideal_target)
        )
        sigma_px = np.hypot(self.options.noise_floor_px, self.options.bias_px_per_deg * turn_deg)
        normal, rhs, lever = self._by_landmarks(pose, agree & (self.landmarks >= 0), sigma_px)
        rest = agree & (self.landmarks < 0)
        error = self._epipolar_px(pose, host_pose, rest)
        by_pose, by_host = np.empty((len(error), 6)), np.empty((len(error), 6))
        for k in range(6):
            nudge = np.zeros(6)
            nudge[k] = _STEP
            by_pose[:, k] = self._epipolar_px(pose.retracted(nudge), host_pose, rest) - error
            by_host[:, k] = self._epipolar_px(pose, host_pose.retracted(nudge), rest) - error
        by_pose, by_host = by_pose / _STEP, by_host / _STEP
        weight = 1.0 / (1.0 + (error / sigma_px[rest]) ** 2 / 4.0) ** 2 / sigma_px[rest] ** 2
        normal += (by_pose * weight[:, None]).T @ by_pose
        rhs -= (by_pose * weight[:, None]).T @ error
        return normal, rhs, (by_pose * weight[:, None]).T @ by_host, lever

    def _by_landmarks(
        self, pose: Pose, chosen: NDArray[np.bool_], sigma_px: Array
    ) -> tuple[Array, Array, Array]:
        """Return the landmarks' part: where they appear in the target's image."""
        landmarks = self.landmarks[chosen]
        ideal = self.ideal_target[chosen]
        uncertainty = self.index.uncertainty
        residual, j_pose, j_point = linearized(
            pose,
            self.target.body_from_cam,
            self.target.camera.pixel_slopes(ideal),
            self.index.landmark_map.points_world[landmarks],
            ideal,
        )
        own = uncertainty.landmark_covariance[landmarks]
        covariance = j_point @ own @ np.swapaxes(j_point, 1, 2)
        covariance[:, [0, 1], [0, 1]] += sigma_px[chosen, None] ** 2
        information = np.linalg.inv(covariance)
        squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
        weighted = np.einsum("nki,nkl->nil", j_pose, information)
        weighted /= (1.0 + squared / 4.0)[:, None, None] ** 2
        lever = np.einsum(
            "nil,nlj,njk->ik", weighted, j_point, uncertainty.landmark_lever[landmarks]
        )
        normal = np.einsum("nik,nkj->ij", weighted, j_pose)
        return normal, -np.einsum("nik,nk->i", weighted, residual), lever

    def _target_from_host(self, pose: Pose, host_pose: Pose) -> Pose:
        world_from_target = pose @ self.target.body_from_cam
        return world_from_target.inverse() @ host_pose @ self.host.body_from_cam

    def _epipolar_px(self, pose: Pose, host_pose: Pose, chosen: NDArray[np.bool_]) -> Array:
        relative = self._target_from_host(pose, host_pose)
        length = max(float(np.linalg.norm(relative.translation)), 1e-9)
        unit = Pose(relative.rotation, relative.translation / length)
        return sampson_px(unit, self.ideal_host[chosen], self.ideal_target[chosen], self.focal_px)


def _parallax(target_from_host: Pose, ideal_host: Array, ideal_target: Array) -> Array:
    """Return (M,) angle under which the two cameras see each match, rad."""
    rays_host = np.hstack([ideal_host, np.ones((len(ideal_host), 1))]) @ target_from_host.rotation.T
    rays_target = np.hstack([ideal_target, np.ones((len(ideal_target), 1))])
    cosine = np.einsum("ni,ni->n", rays_host, rays_target) / (
        np.linalg.norm(rays_host, axis=1) * np.linalg.norm(rays_target, axis=1)
    )
    return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))
