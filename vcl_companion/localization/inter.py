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

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.relative_attitude import relative_attitude
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.pair_evidence import (
    Agreement,
    InterOptions,
    Observer,
    PairEvidence,
)
from vcl_companion.vision.essential import (
    EssentialOptions,
    RelativePose,
    relative_poses,
)
from vcl_companion.vision.information import robust_sigma
from vcl_companion.vision.matching import MatchOptions, match_guided, match_mutual
from vcl_companion.vision.triangulation import triangulate

_SAME_LANDMARK_PX = 3.0
# What one wrong match that happens to lie on a line is worth to a hypothesis.
_ONE_MATCH = 9.0
_MAX_ROUNDS = 5


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
    attitude = relative_attitude(host, target)
    guess = None if attitude is None else attitude.b_from_a
    hypotheses = relative_poses(ideal_host, ideal_target, focal_px, guess, EssentialOptions(), seed)
    hypotheses = [h for h in hypotheses if h.inliers.sum() >= options.min_matches]
    if not hypotheses:
        return NoProposal(f"too little in common with the host ({len(i)} matches)")
    pair = PairEvidence(
        host,
        target,
        host_pose,
        index,
        ideal_host,
        ideal_target,
        focal_px,
        _landmarks_of(host, host_pose, index, i),
        _expected_rotation(host, host_pose, target),
        options,
    )
    judged = [_placed(hypothesis, pair) for hypothesis in hypotheses]
    usable = [s for s in judged if isinstance(s, _Placed)]
    if not usable:
        return next(s for s in judged if isinstance(s, NoProposal))
    # By the total cost over all matches, never by the smallest sigma: that chooses
    # the planar twin.
    best = min(usable, key=lambda s: s.cost)
    covariance = pair.covariance(best.world_from_body, best.chosen, host_covariance)
    if not np.all(np.isfinite(covariance)):
        return NoProposal("what both see does not fix the target's pose")
    covariance = covariance + _spread(best, usable)
    covariance = 0.5 * (covariance + covariance.T)
    sigma_m = worst_sigma(covariance[:3, :3])
    if not sigma_m <= options.max_sigma_m:
        return NoProposal(f"too uncertain: {sigma_m:.2f} m, {options.max_sigma_m:.2f} m allowed")
    return Proposal(best.world_from_body, covariance, best.n_matches, best.n_common)


@dataclass(frozen=True, eq=False)
class _Placed:
    """A hypothesis in the world: the target's pose, what it costs, and who supports it."""

    world_from_body: Pose
    cost: float
    chosen: Agreement

    @property
    def n_matches(self) -> int:
        return int((self.chosen.epipolar | self.chosen.landmark).sum())

    @property
    def n_common(self) -> int:
        return int(self.chosen.landmark.sum())


def _spread(best: _Placed, rivals: list[_Placed]) -> Array:
    """Return (6, 6) how far apart hypotheses are that explain the matches nearly as well.

    With few matches the cost has several minima close to each other, and the
    slope at one of them knows nothing of the next. Which is the lowest may be up
    to a single wrong match.
    """
    spread = np.zeros((6, 6))
    total = 0.0
    for rival in rivals:
        weight = float(np.exp(-0.5 * (rival.cost - best.cost) / _ONE_MATCH))
        off = best.world_from_body.local(rival.world_from_body)
        spread += weight * np.outer(off, off)
        total += weight
    return spread / total


def _expected_rotation(host: Observer, host_pose: Pose, target: Observer) -> Array | None:
    """Return the target's world_from_body (3, 3) by both autopilots and the host's pose."""
    if host.ned_from_body is None or target.ned_from_body is None:
        return None
    return np.asarray(host_pose.rotation @ host.ned_from_body.T @ target.ned_from_body)


def _landmarks_of(
    host: Observer, host_pose: Pose, index: MapIndex, chosen: NDArray[np.intp]
) -> NDArray[np.intp]:
    """Return (M,) the landmark of the map behind each match, by the host's feature; -1 without."""
    cam_from_world = (host_pose @ host.body_from_cam).inverse()
    predicted_px = host.camera.project(cam_from_world.apply(index.landmark_map.points_world))
    found, landmarks = match_guided(
        host.features, index.entries, index.owner, predicted_px, _SAME_LANDMARK_PX, MatchOptions()
    )
    out = np.full(len(host.features), -1, dtype=np.intp)
    out[found] = landmarks
    return np.asarray(out[chosen])


def _placed(hypothesis: RelativePose, pair: PairEvidence) -> _Placed | NoProposal:
    """Give a hypothesis its scale, and refine it over all that agrees with it.

    The scale begins as the ratio of depths in the map and at baseline 1. The
    refinement weighs all evidence together: where the common landmarks
    appear in the target's image, the epipolar lines of all other matches,
    and the autopilots' attitudes. Who agrees is decided anew after it: what
    fits a relative pose alone may not fit the map.
    """
    scaled = _scaled(hypothesis, pair)
    if isinstance(scaled, NoProposal):
        return scaled
    pose = scaled
    chosen = Agreement(hypothesis.inliers & (pair.landmarks < 0), pair.known(hypothesis.inliers))
    for _ in range(_MAX_ROUNDS):
        pose = pair.refined(pose, chosen)
        again = pair.agreeing(pose)
        if again.same(chosen):
            break
        chosen = again
    for _ in range(_MAX_ROUNDS):
        checked = pair.undecisive(pose, chosen)
        if checked.same(chosen):
            break
        chosen = checked
        pose = pair.refined(pose, chosen)
    else:
        return NoProposal("single matches decide the pose: the others do not fix it")
    placed = _Placed(pose, pair.cost(pose), chosen)
    if placed.n_common < pair.options.min_common:
        return _too_few(placed.n_common, pair.options)
    if placed.n_matches < pair.options.min_matches:
        return NoProposal(f"{placed.n_matches} matches agree with the map")
    return placed


def _scaled(hypothesis: RelativePose, pair: PairEvidence) -> Pose | NoProposal:
    """Return the target's pose with the scale by the ratio of depths."""
    agree = hypothesis.inliers
    cams = [Pose.identity(), hypothesis.b_from_a.inverse()]
    rays = np.stack([pair.ideal_host[agree], pair.ideal_target[agree]], axis=1)
    points = triangulate(cams, rays)
    known = pair.landmarks[agree] >= 0
    world_from_cam = pair.host_pose @ pair.host.body_from_cam
    in_map = pair.index.landmark_map.points_world[pair.landmarks[agree][known]]
    with np.errstate(invalid="ignore", divide="ignore"):
        log_ratio = np.log(world_from_cam.inverse().apply(in_map)[:, 2] / points[known, 2])
    log_ratio = log_ratio[np.isfinite(log_ratio)]
    if len(log_ratio) < pair.options.min_common:
        return _too_few(len(log_ratio), pair.options)
    middle = float(np.median(log_ratio))
    spread = robust_sigma(log_ratio - middle)
    if spread > pair.options.max_scale_spread:
        return NoProposal(
            f"the scale varies by {100 * spread:.0f} % over the common landmarks, "
            f"{100 * pair.options.max_scale_spread:.0f} % allowed"
        )
    unit = hypothesis.b_from_a
    target_from_host = Pose(unit.rotation, np.exp(middle) * unit.translation)
    return world_from_cam @ target_from_host.inverse() @ pair.target.body_from_cam.inverse()


def _too_few(n_common: int, options: InterOptions) -> NoProposal:
    least = options.min_common
    return NoProposal(f"{n_common} landmarks in common with the host, {least} needed for the scale")
