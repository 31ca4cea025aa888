"""Relative pose of two cameras from matches: all hypotheses, not just one (IV-B, eq. 3).

A facade is nearly a plane, and two views of a plane have two relative poses
that explain them equally well (the planar twins). Every plausible hypothesis
is therefore refined and returned with its cost over **all** matches; the caller
decides with what else it knows (attitude, a third view).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between, exp_so3, skew
from vcl_companion.vision.acransac import AcRansacOptions
from vcl_companion.vision.epipolar import signed_sampson
from vcl_companion.vision.information import robust_sigma
from vcl_companion.vision.relative_pose import essential_candidates
from vcl_companion.vision.triangulation import triangulate

_MIN_MATCHES = 12


@dataclass(frozen=True)
class EssentialOptions:
    """How relative poses are searched.

    Attributes:
        noise_px: 1-sigma of the epipolar (Sampson) distance in the cost.
        max_samples: of each search (five-point and plane).
    """

    noise_px: float = 0.5
    max_samples: int = 20000


@dataclass(frozen=True, eq=False)
class RelativePose:
    """One hypothesis.

    Attributes:
        b_from_a: camera a's coordinates to camera b's; the translation has length 1.
        inliers: (M,) bool, matches it explains, in front of both cameras.
        cost: sum over all matches of the squared normalised Sampson distance, truncated at 9.
    """

    b_from_a: Pose
    inliers: np.ndarray[tuple[int], np.dtype[np.bool_]]
    cost: float


def relative_poses(
    ideal_a: Array,
    ideal_b: Array,
    focal_px: float,
    rotation_guess: Array | None,
    options: EssentialOptions,
    seed: int = 0,
) -> list[RelativePose]:
    """Find every distinct relative pose that explains the matches.

    Args:
        ideal_a: (M, 2) ideal image coordinates x/z, y/z in camera a.
        ideal_b: (M, 2) the same places in camera b. A match that is not finite
            on either side is nobody's inlier and costs nothing.
        focal_px: px per ideal unit.
        rotation_guess: (3, 3) b_from_a from the autopilots' attitudes, or None.
        options: search settings.
        seed: of the search.

    Returns:
        Hypotheses, cheapest first; empty when there are too few matches.
    """
    usable = np.isfinite(np.hstack([ideal_a, ideal_b])).all(axis=1)
    if usable.sum() < _MIN_MATCHES:
        return []
    ideal_a, ideal_b = ideal_a[usable], ideal_b[usable]
    search = AcRansacOptions(max_samples=options.max_samples)
    rng = np.random.default_rng(seed)
    found_by_search = essential_candidates(ideal_a, ideal_b, focal_px, rng, search)
    starts = [candidate.b_from_a for candidate in found_by_search]
    if rotation_guess is not None:
        starts.append(_translation_only(ideal_a, ideal_b, rotation_guess))
    found: list[RelativePose] = []
    for start in starts:
        refined = _refined(start, ideal_a, ideal_b, focal_px, options)
        hypothesis = _judged(refined, ideal_a, ideal_b, focal_px, options)
        if hypothesis.inliers.sum() < _MIN_MATCHES:
            continue
        twin = next((k for k, f in enumerate(found) if _same(f.b_from_a, refined)), None)
        if twin is None:
            found.append(hypothesis)
        elif hypothesis.cost < found[twin].cost:
            found[twin] = hypothesis
    for k, hypothesis in enumerate(found):
        inliers = np.zeros(usable.shape[0], dtype=np.bool_)
        inliers[usable] = hypothesis.inliers
        found[k] = replace(hypothesis, inliers=inliers)
    return sorted(found, key=lambda h: h.cost)


def sampson_px(b_from_a: Pose, ideal_a: Array, ideal_b: Array, focal_px: float) -> Array:
    """Return (M,) signed first-order epipolar distances, px."""
    essential = skew(b_from_a.translation) @ b_from_a.rotation
    # A kernel is compiled once more for arrays that may not be written.
    a, b = np.array(ideal_a), np.array(ideal_b)
    return np.asarray(signed_sampson(essential[None], a, b, focal_px)[0])


def _translation_only(a: Array, b: Array, rotation: Array) -> Pose:
    """Solve t . (x_b x R x_a) = 0 for the direction t, robustly, with the rotation given."""
    rays_a = np.hstack([a, np.ones((len(a), 1))]) @ rotation.T
    rays_b = np.hstack([b, np.ones((len(b), 1))])
    normals = np.cross(rays_b, rays_a)
    weight = np.ones(len(a))
    direction = np.zeros(3)
    for _ in range(15):
        _, vectors = np.linalg.eigh((normals * weight[:, None]).T @ normals)
        direction = vectors[:, 0]
        error = normals @ direction
        scale = max(robust_sigma(error), 1e-6)
        weight = 1.0 / (1.0 + (error / (2.0 * scale)) ** 2)
    forward = Pose(rotation, direction)
    backward = Pose(rotation, -direction)
    return max(forward, backward, key=lambda pose: int(_in_front(pose, a, b).sum()))


def _in_front(b_from_a: Pose, a: Array, b: Array) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return (M,) whether each match lies in front of both cameras (cheirality)."""
    a_from_b = b_from_a.inverse()
    points_a = triangulate([Pose.identity(), a_from_b], np.stack([a, b], axis=1))
    points_b = b_from_a.apply(points_a)
    return np.asarray((points_a[:, 2] > 0) & (points_b[:, 2] > 0))


def _refined(start: Pose, a: Array, b: Array, focal_px: float, options: EssentialOptions) -> Pose:
    """Levenberg-Marquardt on the five parameters, Cauchy loss on the Sampson distance."""
    scale = 2.0 * options.noise_px
    pose, damping = start, 1e-3
    error = sampson_px(pose, a, b, focal_px)
    cost = float(np.log1p((error / scale) ** 2).sum())
    for _ in range(25):
        basis = _tangent(pose.translation)
        jacobian = np.empty((len(a), 5))
        for k in range(5):
            delta = np.zeros(5)
            delta[k] = 1e-6
            jacobian[:, k] = (
                sampson_px(_stepped(pose, delta, basis), a, b, focal_px) - error
            ) / 1e-6
        weight = 1.0 / (1.0 + (error / scale) ** 2)
        normal = (jacobian * weight[:, None]).T @ jacobian
        rhs = -(jacobian * weight[:, None]).T @ error
        try:
            damped = normal + damping * np.diag(np.diag(normal) + 1e-9)
            step = np.asarray(np.linalg.solve(damped, rhs), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        candidate = _stepped(pose, step, basis)
        new_error = sampson_px(candidate, a, b, focal_px)
        new_cost = float(np.log1p((new_error / scale) ** 2).sum())
        if new_cost < cost:
            done = cost - new_cost < 1e-6 * cost
            pose, error, cost, damping = candidate, new_error, new_cost, damping / 5.0
            if done:
                break
        else:
            damping *= 8.0
            if damping > 1e6:
                break
    return pose


def _stepped(pose: Pose, delta: Array, basis: Array) -> Pose:
    translation = pose.translation + basis @ delta[3:]
    return Pose(pose.rotation @ exp_so3(delta[:3]), translation / np.linalg.norm(translation))


def _tangent(direction: Array) -> Array:
    """Return (3, 2) two axes across a unit direction."""
    _, _, vt = np.linalg.svd(direction[None, :])
    return np.asarray(vt[1:].T)


def _judged(
    pose: Pose, a: Array, b: Array, focal_px: float, options: EssentialOptions
) -> RelativePose:
    normalised = (sampson_px(pose, a, b, focal_px) / options.noise_px) ** 2
    normalised = np.where(_in_front(pose, a, b), np.minimum(normalised, 9.0), 9.0)
    return RelativePose(pose, np.asarray(normalised < 9.0), float(normalised.sum()))


def _same(one: Pose, other: Pose) -> bool:
    turn = angle_between(one.rotation, other.rotation)
    cosine = float(np.clip(one.translation @ other.translation, -1.0, 1.0))
    return bool(turn < np.deg2rad(0.3) and cosine > np.cos(np.deg2rad(1.5)))
