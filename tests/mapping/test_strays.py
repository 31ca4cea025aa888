"""Windows taken for the next one: far behind the wall, and bending the poses that fit them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.mapping.strays import strays

CAMERA = Camera(640, 480, 540.0, 540.0, 319.5, 239.5)
WALL, NEAR, WRONG = 400, 40, 40


class Facade:
    """A slanted wall, something before it, and windows found in the next window's place."""

    def __init__(
        self,
        noise_px: float,
        bent_deg: float = 0.05,
        seed: int = 5,
        aside_px: float | None = None,
        slant: float = 2.5e-5,
    ) -> None:
        rng = np.random.default_rng(seed)
        n = WALL + NEAR + WRONG
        pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (n, 2))
        depth = 1.0 / (0.05 - slant * pixels[:, 0])
        depth[WALL : WALL + NEAR] = 8.0
        rays = np.hstack([CAMERA.ideal_from_pixels(pixels), np.ones((n, 1))])
        self.points = rays * depth[:, None]
        turn = exp_so3(np.array([0.02, -0.1, 0.01]))
        other = Pose(turn, np.array([4.0, 0.3, 0.5]))
        # Some 60 px farther along the epipolar line, nearly: ten times as deep.
        self.points[WALL + NEAR :] *= 10.0
        there = CAMERA.project(other.inverse().apply(self.points))
        aside_px = max(1.0, 10.0 * noise_px) if aside_px is None else aside_px
        there[WALL + NEAR :, 1] += rng.normal(aside_px, 0.1, WRONG)
        there += rng.normal(0.0, noise_px, there.shape)
        self.observed_px = np.stack([pixels, there], axis=1)
        bent = Pose(turn @ exp_so3(np.deg2rad([bent_deg, 0.0, 0.0])), other.translation)
        self.cams = [Pose.identity(), bent]
        self.is_wrong = np.arange(n) >= WALL + NEAR

    def strays(self, cut_from: int = 0) -> NDArray[np.bool_]:
        """(N, 2) which patches stray that were cut from one view and found in both."""
        reference = np.full(len(self.points), cut_from, dtype=np.intp)
        return strays(self.points, self.observed_px, reference, [CAMERA] * 2, self.cams)


@pytest.mark.parametrize("noise_px", [0.03, 0.1, 0.2])
@pytest.mark.parametrize("cut_from", [0, 1])
def test_what_lies_behind_its_neighbours_and_aside_of_their_lines_is_found(
    noise_px: float, cut_from: int
) -> None:
    scene = Facade(noise_px)

    found = scene.strays(cut_from)

    assert not found[:, cut_from].any()
    other = found[:, 1 - cut_from]
    assert other[scene.is_wrong].mean() > 0.9
    assert other[~scene.is_wrong].mean() < 0.01


@pytest.mark.parametrize("bent_deg", [0.0, 0.1, 0.5])
def test_poses_that_are_some_pixels_off_let_nothing_good_be_lost(bent_deg: float) -> None:
    scene = Facade(0.05, bent_deg)

    found = scene.strays()[:, 1]

    assert found[scene.is_wrong].all()
    assert found[~scene.is_wrong].mean() < 0.01


@pytest.mark.parametrize("noise_px", [0.1, 0.15])
def test_windows_that_hardly_miss_are_not_believed_where_all_of_them_miss(noise_px: float) -> None:
    lost, found = [], []
    for seed in range(8):
        scene = Facade(noise_px, seed=seed, aside_px=4.0 * noise_px, slant=0.0)
        # Nothing stands before the wall: turned and moved a little it looks as it did.
        scene.observed_px[WALL : WALL + NEAR] = np.nan
        told = scene.strays()[:, 1]
        lost.append(told[:WALL].mean())
        found.append(told[scene.is_wrong].mean())

    assert np.mean(found) > 0.95, found
    assert max(lost) < 0.02, lost


@pytest.mark.parametrize("noise_px", [0.05, 0.2])
def test_what_stands_before_a_wall_stays_for_it_fits_the_pose(noise_px: float) -> None:
    lost = []
    for seed in range(10):
        scene = Facade(noise_px, seed=seed)
        lost.append(scene.strays()[WALL : WALL + NEAR].mean())
    assert max(lost) <= 0.1, lost


def test_a_wall_in_a_corner_says_little_of_the_rest() -> None:
    scene, rng = Facade(0.2), np.random.default_rng(2)
    pixels = scene.observed_px[:, 0]
    # Elsewhere everything is rough: no landmark is as deep as those beside it.
    corner = (pixels < (200.0, 150.0)).all(axis=1)
    scene.points *= np.where(corner, 1.0, np.exp(rng.uniform(-1.0, 1.0, len(pixels))))[:, None]
    straight = Facade(0.2, bent_deg=0.0).cams[1]
    seen = CAMERA.project(straight.inverse().apply(scene.points))
    scene.observed_px[:, 1] = seen + rng.normal(0.0, 0.2, pixels.shape)
    scene.observed_px[scene.is_wrong] = np.nan

    assert scene.strays()[~scene.is_wrong].mean() < 0.02


def test_of_three_views_the_one_that_was_found_wrong_is_told() -> None:
    scene = Facade(0.05)
    third = Pose(scene.cams[1].rotation, np.array([-3.0, -0.5, 0.2]))
    ahead = third.inverse().apply(scene.points)
    observed = np.concatenate([scene.observed_px, CAMERA.project(ahead)[:, None]], axis=1)
    reference = np.arange(len(scene.points), dtype=np.intp) % 2
    n = len(scene.points)

    found = strays(scene.points, observed, reference, [CAMERA] * 3, [*scene.cams, third])

    assert not found[np.arange(n), reference].any()
    assert found[np.arange(n), 1 - reference][scene.is_wrong].mean() > 0.9
    assert found[~scene.is_wrong].mean() < 0.01


def test_views_from_one_place_have_no_lines() -> None:
    scene = Facade(0.05)
    scene.cams[1] = Pose(scene.cams[1].rotation, scene.cams[0].translation)

    assert not scene.strays().any()


def test_a_view_that_finds_little_is_left_alone() -> None:
    scene = Facade(0.05)
    few = np.arange(len(scene.points)) >= len(scene.points) - 30
    scene.observed_px = np.where(few[:, None, None], scene.observed_px, np.nan)

    assert not scene.strays().any()
