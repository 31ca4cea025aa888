"""Relative poses of two cameras by a-contrario RANSAC: every meaningful one (IV-B, eq. 3).

The essential matrix is searched by five matches, and beside it a plane by four:
two views of a plane have two relative poses that explain them equally well (the
planar twins), and the plane's homography gives both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, log_so3, skew
from vcl_companion.vision.acransac import (
    THRESHOLD_SIGMAS,
    AcRansacOptions,
    Consensus,
    Indices,
    Mask,
    NotFound,
    ac_ransac,
    consensus_of,
)
from vcl_companion.vision.epipolar import (
    linearize,
    refined_essential,
    refined_pose,
    squared_sampson,
    tangent,
)
from vcl_companion.vision.five_point import MAX_MODELS, SAMPLE_SIZE, essentials_of_samples
from vcl_companion.vision.homography import HomographyProblem, poses_of_homography
from vcl_companion.vision.plane_parallax import plausibility

_ROUNDS = 30
_ROUNDS_OF_A_REFIT = 6
# Poses with this share of the best one's inliers in front of both cameras are judged as well.
_CHEIRALITY_TIE = 0.5
_SURE_SIGMAS = 3.0
# One hypothesis found twice, whatever the noise.
_SAME_TURN_RAD = np.deg2rad(0.3)
_SAME_DIRECTION_RAD = np.deg2rad(1.5)
# Near enough to ask whether it is; and what makes the answer yes: sigmas, or plainly less likely.
_NEAR_TURN_RAD = np.deg2rad(3.0)
_NEAR_DIRECTION_RAD = np.deg2rad(15.0)
_SAME_SIGMAS = 6.0
_LESSER = 10.0


@dataclass(frozen=True, eq=False)
class RelativeCandidate:
    """One relative pose that cannot be chance.

    Attributes:
        b_from_a: camera a's coordinates to camera b's; the translation has length 1.
        inliers: (M,) bool, matches within the threshold and in front of both cameras.
        threshold_px: of the Sampson distance, found from the data.
        sigma_px: noise of the good matches' Sampson distance, 1 sigma, likewise.
        log_nfa: natural logarithm of the number of false alarms of its essential
            matrix; negative, unless only a plane makes it meaningful.
        on_plane: it was found from a plane's homography.
        plausibility: natural logarithm of how much likelier all matches are under it
            than if all were wrong, the plane counted where there is one.
    """

    b_from_a: Pose
    inliers: Mask
    threshold_px: float
    sigma_px: float
    log_nfa: float
    on_plane: bool
    plausibility: float = -np.inf


@dataclass(frozen=True, eq=False)
class RelativePoseProblem:
    """Essential matrices for ``ac_ransac``; the error is Sampson's distance.

    Attributes:
        a, b: (N, 2) ideal image coordinates in the two cameras.
        focal_px: px per ideal unit.
        diagonal_px, area_px2: of the part of the images in which wrong matches lie.
    """

    a: Array
    b: Array
    focal_px: float
    diagonal_px: float
    area_px2: float
    sample_size: int = SAMPLE_SIZE
    max_models: int = MAX_MODELS
    dimension: int = 1

    @property
    def n_data(self) -> int:
        """How many matches there are."""
        return len(self.a)

    @property
    def log_alpha(self) -> float:
        """Log of the share of an image within 1 px of Sampson distance from an epipolar line.

        The line is at most a diagonal long. Sampson's distance shares the way
        between both images: it is the distance from the line over the square
        root of 2.
        """
        return float(np.log(2.0 * np.sqrt(2.0) * self.diagonal_px / self.area_px2))

    def fit(self, samples: Indices) -> Array:
        """Return (K, 3, 3) essential matrices of (B, 5) samples."""
        return essentials_of_samples(self.a, self.b, samples)

    def squared_errors(self, models: Array) -> Array:
        """Return (K, N) squared Sampson distances, px^2."""
        return squared_sampson(models, self.a, self.b, self.focal_px)

    def refit(self, model: Array, threshold: float) -> Array:
        """Return the essential matrix most likely to be behind all matches."""
        return refined_essential(
            model, self.a, self.b, self.focal_px,
            threshold / THRESHOLD_SIGMAS, np.exp(self.log_alpha), _ROUNDS_OF_A_REFIT,
        )  # fmt: skip

    def refined(self, pose: Pose, threshold_px: float, rounds: int = _ROUNDS) -> tuple[Pose, float]:
        """Return the most likely pose near a given one, and the noise of its inliers, px."""
        rotation, direction, sigma, _ = refined_pose(
            np.array(pose.rotation, order="C"),
            pose.translation.copy(),
            self.a, self.b, self.focal_px,
            threshold_px / THRESHOLD_SIGMAS, np.exp(self.log_alpha), rounds,
        )  # fmt: skip
        return Pose(rotation, direction), sigma

    def information(self, pose: Pose, sigma_px: float, inliers: Mask) -> Array:
        """Return the (5, 5) inverse covariance of a pose (eq. 12): turn, rad, then direction.

        The turn is a rotation vector on the right, the direction's error lies along
        ``tangent(pose.translation)``.
        """
        _, slopes = self.linearized(pose)
        return np.asarray(slopes[inliers].T @ slopes[inliers] / sigma_px**2)

    def linearized(self, pose: Pose) -> tuple[Array, Array]:
        """Return (N,) signed Sampson distances, px, and their (N, 5) slopes; see above."""
        residual, slopes = np.empty(self.n_data), np.empty((self.n_data, 5))
        rotation = np.array(pose.rotation, order="C")
        linearize(
            rotation, pose.translation.copy(), self.a, self.b, self.focal_px, residual, slopes
        )
        return residual, slopes


def essential_candidates(
    ideal_a: Array,
    ideal_b: Array,
    focal_px: float,
    rng: np.random.Generator,
    options: AcRansacOptions | None = None,
) -> list[RelativeCandidate]:
    """Find every distinct relative pose that the matches make meaningful.

    Args:
        ideal_a: (M, 2) ideal image coordinates x/z, y/z in camera a, finite.
        ideal_b: (M, 2) the same places in camera b.
        focal_px: px per ideal unit.
        rng: of the search; the same one gives the same answer.
        options: how long to search.

    Returns:
        Candidates, most plausible first; empty when the matches are no better
        than chance. Two that are nearly as plausible are planar twins: what else
        is known has to decide.
    """
    if len(ideal_a) <= SAMPLE_SIZE + 1:
        return []
    problem = relative_pose_problem(ideal_a, ideal_b, focal_px)
    a, b, focal_px, area = problem.a, problem.b, problem.focal_px, problem.area_px2
    judged: list[RelativeCandidate] = []
    found = ac_ransac(problem, rng, options)
    if not isinstance(found, NotFound):
        for start in _facing(poses_of_essential(found.model), a, b, found.inliers):
            pose, sigma = problem.refined(start, found.threshold_px)
            judged.append(_judged(problem, pose, sigma))
    plane = ac_ransac(HomographyProblem(a, b, focal_px, area), rng, options)
    if not isinstance(plane, NotFound):
        for start in _facing(poses_of_homography(plane.model), a, b, plane.inliers):
            judged += _judged_on_plane(problem, start, plane)
    believed = [c for c in judged if c.log_nfa < 0.0 or c.on_plane]
    near_plane = None
    # A guess too large only lets more pass for in front than is.
    sigma = min((c.sigma_px for c in believed), default=1.0)
    if not isinstance(plane, NotFound):
        near_plane = (plane.inliers, plane.threshold_px / THRESHOLD_SIGMAS)
    return _distinct(problem, [_weighed(problem, c, near_plane, sigma) for c in believed])


def relative_pose_problem(ideal_a: Array, ideal_b: Array, focal_px: float) -> RelativePoseProblem:
    """Return the problem of (M, 2) ideal image coordinates in each of two cameras.

    Args:
        ideal_a: in camera a, finite.
        ideal_b: the same places in camera b.
        focal_px: px per ideal unit.
    """
    # A kernel is compiled once more for arrays that may not be written, and for integers.
    focal_px = float(focal_px)
    a, b = (np.array(side, dtype=np.float64, order="C") for side in (ideal_a, ideal_b))
    return RelativePoseProblem(a, b, focal_px, *_extent_px(a, b, focal_px))


def poses_of_essential(essential: Array) -> list[Pose]:
    """Return the four b_from_a, translations of length 1, of an essential matrix (eq. 3)."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.linalg.det(u), vt * np.linalg.det(vt)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [
        Pose(u @ turn @ vt, sign * u[:, 2]) for turn in (quarter, quarter.T) for sign in (1.0, -1.0)
    ]


def in_front(b_from_a: Pose, ideal_a: Array, ideal_b: Array) -> Mask:
    """Return (M,) whether each match meets in front of both cameras (cheirality)."""
    rays_a = np.hstack([ideal_a, np.ones((len(ideal_a), 1))]) @ b_from_a.rotation.T
    rays_b = np.hstack([ideal_b, np.ones((len(ideal_b), 1))])
    # depth_a rays_a + t = depth_b rays_b, crossed with one ray and with the other
    across = np.cross(rays_b, rays_a)
    depth_a = -np.einsum("ni,ni->n", np.cross(rays_b, b_from_a.translation), across)
    depth_b = -np.einsum("ni,ni->n", np.cross(rays_a, b_from_a.translation), across)
    return np.asarray((depth_a > 0.0) & (depth_b > 0.0))


def _extent_px(a: Array, b: Array, focal_px: float) -> tuple[float, float]:
    """Return diagonal, px, and area, px^2, of where matches lie, in the image with the more."""
    spans = [np.maximum(np.ptp(side, axis=0), 1e-6) * focal_px for side in (a, b)]
    widest = max(spans, key=lambda span: float(span.prod()))
    return float(np.linalg.norm(widest)), float(widest.prod())


def _judged(problem: RelativePoseProblem, pose: Pose, sigma_px: float) -> RelativeCandidate:
    essential = skew(pose.translation) @ pose.rotation
    found = consensus_of(problem, essential, possible=_possible(problem, pose, sigma_px))
    return RelativeCandidate(
        pose, found.inliers, found.threshold_px, sigma_px, found.log_nfa, on_plane=False
    )


def _judged_on_plane(
    problem: RelativePoseProblem, start: Pose, plane: Consensus
) -> list[RelativeCandidate]:
    """Return a plane's pose as it is, refined by the plane's matches alone, and by all.

    The first is the best there is where the scene is the plane and nothing else,
    the last where there is more. A line is a weak witness: among many wrong
    matches all of them may lead a pose astray that the plane's alone keep.
    """
    own = replace(problem, a=problem.a[plane.inliers], b=problem.b[plane.inliers])
    kept, kept_sigma = own.refined(start, plane.threshold_px)
    free, free_sigma = problem.refined(kept, plane.threshold_px)
    out = []
    for pose, sigma in ((start, kept_sigma), (kept, kept_sigma), (free, free_sigma)):
        judged = _judged(problem, pose, sigma)
        if judged.log_nfa >= 0.0:
            judged = replace(judged, inliers=plane.inliers, threshold_px=plane.threshold_px)
        out.append(replace(judged, on_plane=True))
    return out


def _weighed(
    problem: RelativePoseProblem,
    candidate: RelativeCandidate,
    near_plane: tuple[Mask, float] | None,
    sigma_px: float,
) -> RelativeCandidate:
    """Return a candidate with its plausibility; ``sigma_px`` is a first guess of the noise."""
    pose = candidate.b_from_a
    gain = plausibility(
        pose, problem.a, problem.b, problem.focal_px, _possible(problem, pose, sigma_px),
        near_plane, sigma_px, problem.diagonal_px, problem.area_px2,
    )  # fmt: skip
    return replace(candidate, plausibility=gain)


def _possible(problem: RelativePoseProblem, pose: Pose, sigma_px: float) -> Mask:
    """Return (M,) which matches may be right: those that are not surely behind a camera.

    Rays that noise alone may have parted meet anywhere.
    """
    noise = _SURE_SIGMAS * sigma_px / problem.focal_px
    ahead = in_front(pose, problem.a, problem.b)
    return np.asarray(ahead | _parallel(pose, problem.a, problem.b, noise))


def _parallel(b_from_a: Pose, a: Array, b: Array, within: float) -> Mask:
    """Return (M,) whether the rays of a match are parallel, give or take (in ideal units)."""
    turned = np.hstack([a, np.ones((len(a), 1))]) @ b_from_a.rotation.T
    z = turned[:, 2]
    parted = turned[:, :2] / np.where(z > 1e-6, z, np.nan)[:, None] - b
    return np.asarray((parted**2).sum(axis=1) < within**2)


def _facing(poses: list[Pose], a: Array, b: Array, inliers: Mask) -> list[Pose]:
    """Return those of some poses that have (nearly) the most inliers in front of both cameras."""
    counts = [int(in_front(pose, a[inliers], b[inliers]).sum()) for pose in poses]
    enough = _CHEIRALITY_TIE * max(counts, default=0)
    return [pose for pose, count in zip(poses, counts, strict=True) if count >= enough]


def _distinct(
    problem: RelativePoseProblem, judged: list[RelativeCandidate]
) -> list[RelativeCandidate]:
    """Drop what is there already; best first."""
    kept: list[RelativeCandidate] = []
    for candidate in sorted(judged, key=lambda c: -c.plausibility):
        if not any(_same(problem, other, candidate) for other in kept):
            kept.append(candidate)
    return kept


def _same(
    problem: RelativePoseProblem, better: RelativeCandidate, other: RelativeCandidate
) -> bool:
    """Return whether a candidate is a better one again, found from elsewhere.

    The likelihood has several maxima close together: noise may have moved the
    pose from one to the other, or one is plainly the lesser.
    """
    pose = better.b_from_a
    turn = log_so3(pose.rotation.T @ other.b_from_a.rotation)
    shift = other.b_from_a.translation - pose.translation
    if np.linalg.norm(turn) < _SAME_TURN_RAD and np.linalg.norm(shift) < _SAME_DIRECTION_RAD:
        return True
    if np.linalg.norm(turn) > _NEAR_TURN_RAD or np.linalg.norm(shift) > _NEAR_DIRECTION_RAD:
        return False
    step = np.concatenate([turn, tangent(pose.translation.copy()) @ shift])
    information = problem.information(pose, better.sigma_px, better.inliers)
    lesser = other.plausibility < better.plausibility - _LESSER
    return lesser or bool(step @ information @ step < _SAME_SIGMAS**2)
