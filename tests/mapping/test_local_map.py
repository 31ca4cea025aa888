"""Maps of a drone's own frames: depths, how frames lie to each other, and what both are off."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.checks import nees, numeric_jacobian
from tests.localization.painted import MOUNTING, photograph, world
from tests.scenes import PINHOLE
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.mapping.given_depths import NOISE_PX, SceneDepth, depths_of
from vcl_companion.mapping.local_map import LocalMap, OwnView, local_map, scene_depth
from vcl_companion.mapping.new_landmarks import shown
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.view_adjustment import (
    Relative,
    adjusted,
    held_by_one,
    relative_map,
)
from vcl_companion.vision.features import FeatureOptions, detect
from vcl_companion.vision.patch_tables import pyramid_of

SCENE = SceneDepth(1 / 40.0, 1 / 3.0, 1 / 13.0, 0.7, 0.7)
NO_PARTS = SCENE.parts(np.zeros((0, 2)), PINHOLE)
# The newest first: to the side and ahead while it turns.
MOVED = tuple(
    Pose(exp_so3(np.array([0.0, 0.0, -0.05 * k])), np.array([-0.15 * k, -0.35 * k, 0.05 * k]))
    for k in range(4)
)
# About the camera itself.
TURNED = tuple(
    Pose(exp_so3(np.array([0.0, 0.0, -0.08 * k])), np.zeros(3)) @ MOUNTING.inverse()
    for k in range(4)
)
TURNED = tuple(MOUNTING @ body for body in TURNED)


@cache
def taken(body: Pose) -> OwnView:
    image = photograph(body, np.random.default_rng(7))
    features = shown(detect(image, "orb", FeatureOptions(max_features=600)), PINHOLE)
    return OwnView(0, pyramid_of(image), features, body)


def views(truth: tuple[Pose, ...], believed: tuple[Pose, ...] | None = None) -> list[OwnView]:
    """Return views, said to be from somewhere: where they were if nothing is said."""
    return [
        replace(taken(true), captured_at_ns=-k, world_from_body=body)
        for k, (true, body) in enumerate(zip(truth, believed or truth, strict=True))
    ]


def independent(sigma_m: float, sigma_rad: float) -> Array:
    return np.diag(np.tile(np.repeat([sigma_m, sigma_rad], 3) ** 2, 4))


def made(
    truth: tuple[Pose, ...],
    believed: tuple[Pose, ...] | None = None,
    covariance: Array | None = None,
) -> LocalMap:
    known = independent(1e-3, 1e-4) if covariance is None else covariance
    found = local_map(views(truth, believed), known, PINHOLE, MOUNTING, 1, SCENE)
    assert isinstance(found, LocalMap), found
    return found


def seen_from(
    bodies: tuple[Pose, ...], rng: np.random.Generator, relief: float
) -> tuple[Array, Array, Array]:
    """Return (N, 2) pixels, (N, V, 2) where views show them and (N,) true inverse depths."""
    cams = [body @ MOUNTING for body in bodies]
    pixels = rng.uniform([60, 40], [580, 440], (400, 2))
    rays = np.column_stack([PINHOLE.ideal_from_pixels(pixels), np.ones(400)])
    true = SCENE.typical * np.exp(relief * rng.standard_normal(400))
    points = cams[0].apply(rays / true[:, None])
    return (
        pixels,
        np.stack([PINHOLE.project(cam.inverse().apply(points)) for cam in cams], axis=1),
        true,
    )


def off_the_world(points: Array, world_from_cam: Pose) -> Array:
    """Return (N,) how far points are from where their rays meet the painted world, as a share."""
    away = points - world_from_cam.translation
    hits = world().intersect(world_from_cam.translation, away)
    there = hits.points_world - world_from_cam.translation
    return np.asarray(np.linalg.norm(away, axis=1) / np.linalg.norm(there, axis=1) - 1.0)


def test_landmarks_lie_on_what_the_frames_show() -> None:
    templates = made(MOVED).templates
    newest = templates.anchors.keyframe == 0
    points = templates.anchors.points_world[newest]
    assert len(points) > 150
    off = off_the_world(points, MOVED[0] @ MOUNTING)
    assert np.median(np.abs(off)) < 0.01
    assert np.mean(np.abs(off) < 0.05) > 0.95


def test_depths_err_as_they_say() -> None:
    """Found as exactly as patches are, from true poses."""
    rng = np.random.default_rng(2)
    pixels, observed, true = seen_from(MOVED, rng, 0.4)
    observed[:, 1:] += NOISE_PX * rng.standard_normal((400, 3, 2))
    parts = SCENE.parts(pixels, PINHOLE)
    found = depths_of(observed, 1.005 * true, list(MOVED), MOUNTING, PINHOLE, SCENE, parts)
    cam = MOVED[0] @ MOUNTING
    rays = np.column_stack([PINHOLE.ideal_from_pixels(pixels), np.ones(400)])
    points = cam.apply(rays / true[:, None])
    distance = np.linalg.norm(points - cam.translation, axis=1)
    along = (points - cam.translation) / distance[:, None]
    error = np.einsum("ni,ni->n", found.points - points, along)
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", along, found.covariance, along))
    assert found.fits.all()
    assert 0.8 < np.mean((error / sigma) ** 2) < 1.25


def test_depths_move_with_the_poses_as_the_lever_says() -> None:
    cams = [body @ MOUNTING for body in MOVED]
    pixels = np.array([[100.0, 90.0], [320.0, 240.0], [500.0, 400.0]])
    rays = np.column_stack([PINHOLE.ideal_from_pixels(pixels), np.ones(3)])
    points = cams[0].apply(rays * np.array([[8.0], [14.0], [11.0]]))
    observed = np.stack([PINHOLE.project(cam.inverse().apply(points)) for cam in cams], axis=1)
    vague = replace(SCENE.parts(pixels, PINHOLE), relief=100.0)

    def placed(step: Array) -> Array:
        bodies = [b.retracted(step[6 * i : 6 * i + 6]) for i, b in enumerate(MOVED)]
        start = np.array([1 / 8.0, 1 / 14.0, 1 / 11.0])
        for _ in range(4):
            found = depths_of(observed, start, bodies, MOUNTING, PINHOLE, SCENE, vague)
            start = 1.0 / (bodies[0] @ MOUNTING).inverse().apply(found.points)[:, 2]
        return found.points

    depths = np.array([1 / 8.0, 1 / 14.0, 1 / 11.0])
    exact = depths_of(observed, depths, list(MOVED), MOUNTING, PINHOLE, SCENE, vague)
    expected = numeric_jacobian(placed, np.zeros(24), 1e-5).reshape(3, 3, 24)
    np.testing.assert_allclose(exact.lever, expected, atol=2e-3 * np.abs(expected).max())


def test_how_frames_lie_to_each_other_is_found_from_where_they_are_not() -> None:
    """The newest one was found half a degree and a hand's breadth from where it was."""
    rng = np.random.default_rng(3)
    sigma = np.repeat([0.05, 0.005], 3)
    off = [body.retracted(sigma * rng.standard_normal(6)) for body in MOVED]
    exact = np.repeat([1e-3, 1e-4], 3)
    covariance = np.diag(np.concatenate([sigma, sigma, exact, sigma]) ** 2)
    off[2] = MOVED[2].retracted(exact * rng.standard_normal(6))
    placement = made(MOVED, tuple(off), covariance).placement
    assert placement.held == 2
    np.testing.assert_allclose(placement.bodies[2].matrix(), off[2].matrix(), atol=1e-9)
    for k in (0, 1, 3):
        error = MOVED[k].local(placement.bodies[k])
        # How far they are apart patches do not tell; which way, they do.
        way = MOVED[k].rotation.T @ (MOVED[k].translation - MOVED[2].translation)
        aside = np.cross(way / np.linalg.norm(way), error[:3])
        assert np.linalg.norm(aside) < 0.03
        assert np.linalg.norm(error[3:]) < 0.001
        own = placement.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert nees(error, own)[0] < 27.9  # 99.99 % of chi^2 with 6 degrees of freedom


def test_a_scale_that_nothing_tells_stays_as_vague_as_it_was() -> None:
    """All poses are a tenth too far apart: patches agree with that as well."""
    stretched = tuple(
        Pose(b.rotation, 1.1 * (b @ MOUNTING).translation - b.rotation @ MOUNTING.translation)
        for b in MOVED
    )
    placement = made(MOVED, stretched, independent(0.03, 0.003)).placement
    way = placement.bodies[3].translation - placement.bodies[0].translation
    apart = np.linalg.norm(way)
    line = np.zeros(24)
    for k, sign in ((0, -1.0), (3, 1.0)):
        line[6 * k : 6 * k + 3] = sign * placement.bodies[k].rotation.T @ way / apart
    sigma_m = np.sqrt(line @ placement.covariance @ line)
    true = np.linalg.norm(MOVED[3].translation - MOVED[0].translation)
    assert abs(apart - true) < 4.0 * sigma_m
    assert 0.01 < sigma_m < 0.05


def test_relief_pulls_on_no_scale() -> None:
    """What is said beforehand of depths is the same at any scale: a chain of maps would grow."""
    pixels, observed, true = seen_from(MOVED, np.random.default_rng(8), 0.4)
    known = relative_map(list(MOVED)) @ independent(0.03, 0.003) @ relative_map(list(MOVED)).T
    parts = SCENE.parts(pixels, PINHOLE)
    found = adjusted(observed, true, list(MOVED), MOUNTING, PINHOLE, SCENE, parts, known)
    newest = MOVED[0] @ MOUNTING
    for k in range(1, 4):
        body = MOVED[k].retracted(found.step[6 * k - 6 : 6 * k])
        apart = np.linalg.norm((body @ MOUNTING).translation - newest.translation)
        was = np.linalg.norm((MOVED[k] @ MOUNTING).translation - newest.translation)
        assert abs(apart / was - 1.0) < 0.003


def test_noise_passes_for_no_relief() -> None:
    """Views a millimetre apart tell no depth; who moves before a wall is not to seem at rest."""
    nearly = tuple(Pose(np.eye(3), 0.002 * b.translation) for b in MOVED)
    rng = np.random.default_rng(9)
    pixels, observed, true = seen_from(nearly, rng, 0.05)
    observed[:, 1:] += NOISE_PX * rng.standard_normal(observed[:, 1:].shape)
    parts = SCENE.parts(pixels, PINHOLE)
    found = depths_of(observed, true, list(nearly), MOUNTING, PINHOLE, SCENE, parts)
    cam = nearly[0] @ MOUNTING
    relief = np.log(cam.inverse().apply(found.points)[:, 2])
    assert np.std(relief) < 0.1
    told = np.sqrt(np.einsum("nij,nij->n", found.by_parts, found.by_parts))
    distance = np.linalg.norm(found.points - cam.translation, axis=1)
    assert np.median(told / distance) > 0.5


def test_what_turns_on_the_spot_is_followed_though_no_depth_is_known() -> None:
    rng = np.random.default_rng(4)
    sigma = np.repeat([0.01, 0.003], 3)
    off = tuple(body.retracted(sigma * rng.standard_normal(6)) for body in TURNED)
    found = made(TURNED, off, independent(0.01, 0.003))
    held = found.placement.held
    for k in range(4):
        true = TURNED[held].inverse() @ TURNED[k]
        lies = found.placement.bodies[held].inverse() @ found.placement.bodies[k]
        assert np.linalg.norm(true.local(lies)[3:]) < 0.002
    # As vague as the scene, not as sharp as a tenth of a pixel.
    depths = found.templates.uncertainty.landmark_covariance
    assert np.median(np.sqrt(np.trace(depths, axis1=1, axis2=2))) > 2.0


def test_views_are_placed_by_the_one_that_is_known_best() -> None:
    covariance = independent(0.1, 0.01)
    covariance[12:18, 12:18] *= 0.01
    learnt = Relative(np.zeros(0), np.zeros(18), 1e-8 * np.eye(18), NO_PARTS)
    placement = held_by_one(list(MOVED), covariance, learnt, SCENE)
    assert placement.held == 2
    for before, after in zip(MOVED, placement.bodies, strict=True):
        np.testing.assert_allclose(after.matrix(), before.matrix(), atol=1e-12)
    np.testing.assert_allclose(placement.by_before[12:18], np.eye(6, 24, 12), atol=1e-12)
    own = placement.covariance[12:18, 12:18]
    np.testing.assert_allclose(own, covariance[12:18, 12:18], rtol=1e-9, atol=1e-15)
    relative = relative_map(list(MOVED))
    np.testing.assert_allclose(
        relative @ placement.covariance @ relative.T, learnt.covariance, atol=1e-12
    )


def test_poses_that_are_made_of_each_other_stay_poses() -> None:
    """From map to map, a hundred times: what rounding leaves is not doubled each time."""
    bodies = list(MOVED)
    rng = np.random.default_rng(6)
    covariance = independent(0.01, 0.001)
    covariance[18:] *= 0.1
    covariance[:, 18:] *= 0.1
    for _ in range(100):
        step = 0.01 * rng.standard_normal(18)
        learnt = Relative(np.zeros(0), step, 1e-8 * np.eye(18), NO_PARTS)
        bodies = held_by_one(bodies, covariance, learnt, SCENE).bodies
        # The next one is made of what was the newest here.
        bodies = [bodies[3], bodies[0], bodies[1], bodies[2]]
    for body in bodies:
        np.testing.assert_allclose(body.rotation @ body.rotation.T, np.eye(3), atol=1e-12)


def test_nothing_comes_of_frames_that_show_nothing_alike() -> None:
    blank = np.full((PINHOLE.height_px, PINHOLE.width_px), 90, np.uint8)
    features = shown(detect(blank, "orb", FeatureOptions()), PINHOLE)
    empty = [OwnView(k, pyramid_of(blank), features, body) for k, body in enumerate(MOVED)]
    found = local_map(empty, independent(0.01, 0.001), PINHOLE, MOUNTING, 1, SCENE)
    assert isinstance(found, NoMap)
    assert "0 patches" in found.reason
    singular = local_map(views(MOVED), np.zeros((24, 24)), PINHOLE, MOUNTING, 1, SCENE)
    assert isinstance(singular, NoMap)
    assert "no covariance" in singular.reason


def test_a_scene_is_as_far_as_what_is_known_of_it_in_view() -> None:
    cam = MOVED[0] @ MOUNTING
    rng = np.random.default_rng(1)
    pixels = rng.uniform([20, 20], [600, 440], (200, 2))
    rays = np.column_stack([PINHOLE.ideal_from_pixels(pixels), np.ones(200)])
    depth = rng.uniform(8.0, 12.0, 200)
    points = cam.apply(rays * depth[:, None])
    behind = cam.apply(-rays * 0.5)
    scene = scene_depth(cam, PINHOLE, np.concatenate([points, behind]))
    assert scene is not None
    assert abs(1.0 / scene.typical - 10.0) < 0.5
    assert scene.least < 1 / 12.0 < 1 / 8.0 < scene.largest
    assert scene_depth(cam, PINHOLE, behind) is None
    assert scene_depth(cam, PINHOLE, points[:10]) is None


@pytest.mark.parametrize("sigma", [0.0, np.nan])
def test_what_views_are_off_to_each_other_must_be_known(sigma: float) -> None:
    observed = np.full((40, 2, 2), 200.0)
    with pytest.raises(ValueError, match="no covariance"):
        adjusted(
            observed, np.full(40, 0.1), list(MOVED[:2]), MOUNTING, PINHOLE, SCENE,
            SCENE.parts(observed[:, 0], PINHOLE), sigma * np.eye(6),
        )  # fmt: skip
