"""How plausible a relative pose is: the truth most, on a plane and off it, among wrong matches."""

import numpy as np
import pytest

from sitl.bench.cases import FOCAL_PX, Case, Cell, case_of
from sitl.bench.trial import judged
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.vision.acransac import Mask
from vcl_companion.vision.plane_parallax import plausibility
from vcl_companion.vision.relative_pose import essential_candidates, in_front

DIAGONAL_PX, AREA_PX2 = 800.0, 307200.0


def unit(pose: Pose) -> Pose:
    return Pose(pose.rotation, pose.translation / np.linalg.norm(pose.translation))


def of(
    case: Case, pose: Pose, sigma_px: float, plane: tuple[Mask, float] | None, possible: bool = True
) -> float:
    ahead = in_front(pose, case.a, case.b) & possible
    return plausibility(
        unit(pose), case.a, case.b, FOCAL_PX, ahead, plane, sigma_px, DIAGONAL_PX, AREA_PX2
    )


def beside(rng: np.random.Generator, truth: Pose, degrees: float) -> Pose:
    """Turn the pose, and its baseline so that the images move as little as can be."""
    axis = rng.standard_normal(3)
    turn = exp_so3(np.deg2rad(degrees) * axis / np.linalg.norm(axis))
    return Pose(turn @ truth.rotation, truth.translation)


@pytest.mark.parametrize("shape", ["planar", "relief"])
@pytest.mark.parametrize("sigma_px", [0.3, 1.0, 3.0])
def test_the_truth_is_more_plausible_than_what_is_beside_it(shape: str, sigma_px: float) -> None:
    rng = np.random.default_rng(0)
    for seed in range(4):
        case = case_of(Cell("relative", "planar" if shape == "planar" else "relief", sigma_px, 0.5),
                       seed)  # fmt: skip
        # Of relief a plane explains something too, but badly.
        spread_px = 1.5 * sigma_px if shape == "planar" else 20.0
        plane = (case.good, spread_px)
        truth = of(case, case.b_from_a, sigma_px, plane)
        assert truth > 100.0
        for degrees in (3.0, 10.0, 40.0):
            assert of(case, beside(rng, case.b_from_a, degrees), sigma_px, plane) < truth - 3.0
        # Two numbers of a match say more than one.
        assert truth > of(case, case.b_from_a, sigma_px, None) + 20.0


def test_the_first_guesses_do_not_matter() -> None:
    case = case_of(Cell("relative", "planar", 1.0, 0.7), 3)
    some = case.good & (np.arange(len(case.good)) % 2 == 0)
    reference = of(case, case.b_from_a, 1.0, (case.good, 1.4))
    for sigma_px, plane in ((0.5, (some, 1.4)), (3.0, (case.good, 10.0)), (1.5, (some, 4.0))):
        assert of(case, case.b_from_a, sigma_px, plane) == pytest.approx(reference, abs=0.5)


def test_the_planar_twins_are_alike() -> None:
    compared = 0
    for seed in range(40):
        case = case_of(Cell("relative", "planar", 0.3, 0.0), seed)
        if case.twin is None or not in_front(case.twin, case.a, case.b).all():
            continue
        compared += 1
        plane = (case.good, 0.5)
        truth, twin = (of(case, pose, 0.3, plane) for pose in (case.b_from_a, case.twin))
        assert truth > 1000.0
        assert twin == pytest.approx(truth, abs=6.0)
        # By what is in front they are told apart at once.
        assert of(case, case.twin, 0.3, plane, possible=False) < 1.0
    assert compared >= 3


def test_wrong_matches_make_nothing_plausible() -> None:
    rng = np.random.default_rng(1)
    case = case_of(Cell("relative", "relief", 1.0, 0.5), 1)
    a, b = rng.uniform(-1.0, 1.0, (2, 300, 2)) * (1.0, 0.75)
    for plane in (None, (np.arange(300) < 8, 2.0)):
        gain = plausibility(
            unit(case.b_from_a), a, b, FOCAL_PX, np.ones(300, dtype=np.bool_), plane,
            1.0, DIAGONAL_PX, AREA_PX2,
        )  # fmt: skip
        assert -1.0 < gain < 15.0


def test_degenerate_matches_give_a_number() -> None:
    pose = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    same = np.zeros((20, 2))
    for plane in (None, (np.ones(20, dtype=np.bool_), 1.0), (np.zeros(20, dtype=np.bool_), 1.0)):
        for possible in (np.ones(20, dtype=np.bool_), np.zeros(20, dtype=np.bool_)):
            gain = plausibility(
                pose, same, same, FOCAL_PX, possible, plane, 1.0, DIAGONAL_PX, AREA_PX2
            )
            assert np.isfinite(gain)


def test_among_many_wrong_matches_and_much_noise_the_plane_decides() -> None:
    """Scenes in which a pose off the plane has the lowest number of false alarms."""
    cell = Cell("relative", "planar", 3.0, 0.7)
    for seed in (1, 50, 126, 139):
        case = case_of(cell, seed)
        found = essential_candidates(case.a, case.b, FOCAL_PX, np.random.default_rng(seed))
        assert found == sorted(found, key=lambda candidate: -candidate.plausibility)
        score = judged("relative", case, [candidate.b_from_a for candidate in found], 0.0)
        assert score.first
        assert score.among
        assert len(found) <= 5
    assert min(c.log_nfa for c in found) < found[0].log_nfa
