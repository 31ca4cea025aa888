"""A drone that turns away from the map: what it goes on by, how sure it says to be, how it returns.

A painted world with truth; every frame goes the way of a daemon's: predicted,
localized by the default pipeline, taken in, else a peer's word, else bridged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from tests.checks import nees
from tests.localization.painted import MOUNTING, painted_map, photograph
from tests.scenes import PINHOLE
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.localization.pipeline import PipelineOptions, localize
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.vision.features import FeatureOptions

OPTIONS = PipelineOptions(FeatureOptions(), LocalizationOptions(), TrackingOptions())
MOTION = FilterOptions(coast_s=1.0)
PER_S, LENGTH_S = 10, 5.4
# Turned by 160 degrees in 1.6 s, for 0.8 s, and back.
LEAVES_S, TURNS_S, RETURNS_S = 0.8, 1.6, 3.2
PEER_SIGMA = np.repeat([0.1, 0.01], 3)


@cache
def chart() -> tuple[MapIndex, Templates]:
    landmark_map = painted_map(np.random.default_rng(3), n=800, recognisable=True)
    index = index_map(landmark_map, "akaze", FeatureOptions())
    return index, prepare_templates(landmark_map, index.uncertainty)


def truth_at(at_s: float) -> tuple[Pose, float]:
    """Where it is and its heading, rad; it comes to a stop while it turns, at 1 m/s^2."""
    share = np.clip((at_s - LEAVES_S) / TURNS_S, 0, 1) - np.clip((at_s - RETURNS_S) / TURNS_S, 0, 1)
    heading = float(np.deg2rad(160.0) * share**2 * (3.0 - 2.0 * share))
    braked_s = min(max(at_s - LEAVES_S, 0.0), 1.0)
    gone = np.array([0.8, -0.6, 0.0]) * (
        min(at_s, LEAVES_S) + braked_s - 0.5 * braked_s**2
    ) + np.array([-1.5, 0.5, -0.3])
    rotation = matrix_from_euler(0.02 * np.sin(3 * at_s), -0.03 * np.sin(2 * at_s), heading)
    return Pose(rotation, gone), heading


def attitude_at(at_s: float, rng: np.random.Generator) -> Array:
    """What the autopilot says: north and level a little off, a gyro that turns 1 % too far."""
    truth, heading = truth_at(at_s)
    off = matrix_from_euler(0.01, -0.01, np.deg2rad(3.0) + 0.01 * heading)
    noise = np.deg2rad(MOTION.attitude_sigma_deg) * rng.standard_normal(3)
    return off @ truth.rotation @ exp_so3(noise)


@dataclass(frozen=True, eq=False)
class Flown:
    """One frame.

    Attributes:
        at_s: its time.
        n_in_view: landmarks of the map that it shows.
        by: what the sent pose relies on; None when nothing is sent.
        sent: that pose and its uncertainty.
        kept: what the drone believes, sent or not.
    """

    at_s: float
    n_in_view: int
    by: str | None
    sent: FilterState | None
    kept: FilterState | None

    @property
    def truth(self) -> Pose:
        return truth_at(self.at_s)[0]

    def squared(self, state: FilterState) -> float:
        return float(nees(self.truth.local(state.world_from_body), state.pose_covariance())[0])


def sigma_m(state: FilterState) -> float:
    return float(np.sqrt(np.linalg.eigvalsh(state.pose_covariance()[:3, :3])[-1]))


def n_in_view(world_from_body: Pose) -> int:
    points = chart()[0].landmark_map.points_world
    pixels = PINHOLE.project((world_from_body @ MOUNTING).inverse().apply(points))
    with np.errstate(invalid="ignore"):
        inside = (pixels > 8).all(axis=1) & (pixels < np.array([632, 472])).all(axis=1)
    return int(inside.sum())


def fly(rng: np.random.Generator, peer_sees: Callable[[int], bool]) -> tuple[list[Flown], int]:
    """Fly; return every frame, and how often the estimate jumped."""
    index, templates = chart()
    jumps: list[str] = []
    estimator = Estimator(MOTION, OPTIONS.localization, jumps.append)
    out = []
    for k in range(round(LENGTH_S * PER_S)):
        at_s = k / PER_S
        at_ns = round(at_s * 1e9)
        truth, _ = truth_at(at_s)
        attitude = attitude_at(at_s, rng)
        predicted = estimator.predicted(at_ns, attitude)
        fix = localize(
            photograph(truth, rng), PINHOLE, MOUNTING, index, templates,
            predicted.prior() if predicted else None, attitude, OPTIONS,
        )  # fmt: skip
        by: str | None = None
        sent = None
        if isinstance(fix, Localized):
            state = estimator.take_fix(predicted, fix, at_ns, attitude)
            sent, by = (state, fix.by) if isinstance(state, FilterState) else (None, None)
        else:
            estimator.take_nothing(predicted, at_ns, attitude)
        if sent is None and peer_sees(k):
            said = truth.retracted(PEER_SIGMA * rng.standard_normal(6))
            covariance = np.diag(PEER_SIGMA**2)
            points = index.landmark_map.points_world
            fused = estimator.take_proposal(at_ns, attitude, said, covariance, points)
            sent, by = (fused, "peer") if isinstance(fused, FilterState) else (None, None)
        if sent is None:
            sent = estimator.coasted_at(at_ns)
            by = "motion" if sent else None
        kept = estimator.predicted(at_ns, attitude)
        out.append(Flown(at_s, n_in_view(truth), by, sent, kept))
    return out, len(jumps)


def assert_it_comes_back(frames: list[Flown]) -> None:
    """Within three frames of seeing enough it has found itself by the map, and stays."""
    back = [f for f in frames if f.at_s > RETURNS_S and f.n_in_view >= 100]
    assert len(back) > 10
    assert all(f.by in ("patches", "features") for f in back[2:])
    for f in back[2:]:
        assert f.sent is not None
        assert np.linalg.norm(f.sent.world_from_body.translation - f.truth.translation) < 0.03
        assert f.squared(f.sent) < 35.0


def test_alone_it_goes_on_by_its_attitude_less_and_less_sure_then_says_nothing() -> None:
    frames, n_jumps = fly(np.random.default_rng(5), lambda _: False)
    away = [f for f in frames if f.by not in ("patches", "features")]
    assert min(f.n_in_view for f in away) == 0
    left_s = frames[frames.index(away[0]) - 1].at_s
    assert all(f.by in ("patches", "features") for f in frames if f.at_s <= left_s)
    # One gap: first by motion, then by nothing.
    bridged = [f for f in away if f.by == "motion"]
    assert away[: len(bridged)] == bridged
    assert 4 <= len(bridged) <= MOTION.coast_s * PER_S
    assert len(away) > len(bridged) + 5
    sigmas = [sigma_m(f.sent) for f in [frames[frames.index(away[0]) - 1], *bridged] if f.sent]
    assert np.all(np.diff(sigmas) > 0.0)
    assert sigmas[-1] < OPTIONS.localization.max_sigma_m
    for f in away:  # sent or not: what it believes errs no more than it says
        assert f.kept is not None
        assert f.squared(f.kept) < 22.5  # 99.9 % of chi^2 with 6 degrees of freedom
        turned = f.truth.local(f.kept.world_from_body)[3:]
        # The attitude keeps the heading, however long.
        assert np.linalg.norm(turned) < np.deg2rad(4.0)
        assert 0.2 < np.rad2deg(np.sqrt(f.kept.pose_covariance()[5, 5])) < 4.0
    assert np.median([f.squared(f.kept) for f in away if f.kept]) > 0.05
    assert n_jumps <= 1
    assert_it_comes_back(frames)


def test_peers_that_see_it_keep_its_pose_all_the_while() -> None:
    """One of three frames is answered by a peer; the others are bridged from there."""
    frames, n_jumps = fly(np.random.default_rng(6), lambda k: k % 3 == 0)
    away = [f for f in frames if f.by not in ("patches", "features")]
    assert {f.by for f in away} == {"peer", "motion"}
    assert min(f.n_in_view for f in away) == 0
    squared = []
    for f in away:
        assert f.sent is not None
        off_m = np.linalg.norm(f.sent.world_from_body.translation - f.truth.translation)
        assert off_m < 0.6
        squared.append(f.squared(f.sent))
    # As uncertain as the peer at best, and no less honest.
    assert min(sigma_m(f.sent) for f in away if f.by == "peer" and f.sent) > 0.02
    assert max(squared) < 27.9
    assert 0.3 < np.median(squared) < 10.0
    assert n_jumps <= 1
    assert_it_comes_back(frames)
