"""The compiled refinement ends where the one in arrays does."""

from __future__ import annotations

import numpy as np
import pytest

from tests.checks import assert_pose_close
from tests.scenes import CAMERAS, facade_scene, perturbed
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.pose_errors import gained
from vcl_companion.vision.pose_kernels import CONVERGED, SINGULAR, converged, supported
from vcl_companion.vision.resection import Resection, ResectionOptions, Sightings, refine

_SCALES = np.array([8.0, 3.0, 1.0, 1.0])
_UPPER = np.triu_indices(3)
System = tuple[Array, Array, Array, Array, Array, Array]


def rows(pose: Pose) -> Array:
    return np.ascontiguousarray(pose.matrix()[:3])


def both(rng: np.random.Generator, camera: Camera) -> tuple[Sightings, Pose, System]:
    """Sightings with noise, a fifth of them wrong; the first guess; the same for the kernel."""
    scene = facade_scene(rng, 250, 3.0, camera=camera, noise_px=0.4, outliers=0.2)
    seen = scene.seen[:, 1]
    n = int(seen.sum())
    root = 0.02 * rng.standard_normal((n, 3, 3))
    covariances = root @ root.swapaxes(1, 2)
    points = scene.points_world[seen] + np.einsum("nij,nj->ni", root, rng.standard_normal((n, 3)))
    sightings = Sightings(
        scene.ideal[seen, 1], points, covariances, camera.focal_px, scene.slopes[seen, 1],
        scene.mountings[1], 0.4, np.full(n, 0.3),
    )  # fmt: skip
    pixel = np.tile([0.4**2 + 0.3**2, 0.0, 0.4**2 + 0.3**2], (n, 1))
    system = (
        rows(scene.mountings[1]), sightings.ideal, sightings.slopes, points,
        covariances[:, *_UPPER], pixel,
    )  # fmt: skip
    return sightings, perturbed(rng, scene.bodies[1], 0.05, 0.005), system


def in_arrays(pose: Pose, sightings: Sightings) -> Pose:
    """The same refinement written once more, all sightings at once."""
    pixel = sightings.noise_px**2 + sightings.bias_px**2
    for scale in _SCALES:
        for _ in range(8):
            residual, j_pose, j_point = linearized(
                pose, sightings.body_from_cam, sightings.slopes, sightings.points, sightings.ideal
            )
            covariance = j_point @ sightings.point_covariances @ j_point.swapaxes(1, 2)
            information = np.linalg.inv((covariance + pixel[:, None, None] * np.eye(2)) * scale**2)
            squared = np.einsum("ni,nij,nj->n", residual, information, residual)
            weighted = information / ((1.0 + squared / 4.0) ** 2)[:, None, None] @ j_pose
            normal = np.einsum("nki,nkj->ij", j_pose, weighted)
            pose = pose.retracted(
                -np.linalg.solve(normal, np.einsum("nki,nk->i", weighted, residual))
            )
    return pose


@pytest.mark.parametrize("camera", CAMERAS, ids=["none", "radial4", "radial5", "fisheye"])
def test_the_same_pose_and_covariance_as_the_refinement_in_arrays(camera: Camera) -> None:
    rng = np.random.default_rng(2)
    sightings, start, system = both(rng, camera)
    expected = refine(start, sightings, ResectionOptions())
    assert isinstance(expected, Resection)
    matrix, outcome = converged(rows(start), *system, np.zeros((6, 6)), _SCALES)
    assert outcome == CONVERGED
    found = Pose(matrix[:, :3], matrix[:, 3])
    assert_pose_close(found, in_arrays(start, sightings), within_m=1e-5, within_rad=1e-6)
    assert_pose_close(found, expected.world_from_body, within_m=1e-7, within_rad=1e-8)
    agrees, normal, j_poses, j_points, roots, weights, squared_px = supported(
        matrix, *system, 18.42
    )
    assert np.array_equal(agrees, expected.inliers)
    n = len(agrees)
    assert np.isclose(np.sqrt(squared_px / agrees.sum()), expected.rms_px)
    levers = rng.standard_normal((n, 3, 12)).astype(np.float32)
    own = rng.standard_normal((n, 3))
    leverage, parts, lever = gained(
        np.linalg.inv(normal), j_poses, j_points, roots, weights,
        np.tile([0.16, 0.0, 0.16], (n, 1)), np.tile([0.09, 0.0, 0.09], (n, 1)),
        own, np.arange(n, dtype=np.int64), levers,
    )  # fmt: skip
    assert np.allclose(1.1136 * parts[0], expected.noise_covariance, rtol=1e-4)
    assert np.allclose(1.1136 * parts[1], expected.bias_covariance, rtol=1e-4)
    by_point = -expected.gain @ expected.jacobian_points
    moved = np.einsum("nij,nj->ni", by_point, own[expected.inliers])
    assert np.allclose(parts[2], moved.T @ moved, rtol=1e-4)
    assert np.allclose(lever, np.einsum("nij,njk->ik", by_point, levers[expected.inliers]))
    eigenvalues = np.linalg.eigvals(expected.jacobian_pose @ expected.gain)
    assert np.allclose(leverage[expected.inliers], np.abs(eigenvalues).max(axis=1), rtol=1e-4)


def test_a_strong_prior_holds_the_pose() -> None:
    _, start, system = both(np.random.default_rng(3), CAMERAS[0])
    matrix, outcome = converged(rows(start), *system, 1e12 * np.eye(6), _SCALES)
    assert outcome == CONVERGED
    held = Pose(matrix[:, :3], matrix[:, 3])
    assert_pose_close(held, start, within_m=1e-5, within_rad=1e-6)


def test_landmarks_behind_the_camera_fix_nothing() -> None:
    _, start, system = both(np.random.default_rng(3), CAMERAS[0])
    behind = Pose(start.rotation @ np.diag([-1.0, -1.0, 1.0]), start.translation)
    assert converged(rows(behind), *system, np.zeros((6, 6)), _SCALES)[1] == SINGULAR


@pytest.mark.parametrize("n_distinct", [1, 2])
def test_landmarks_all_in_a_place_or_two_fix_nothing(n_distinct: int) -> None:
    """However many they are; and nothing is raised in the middle of a frame."""
    _, start, system = both(np.random.default_rng(3), CAMERAS[0])
    mounting, ideal, slopes, points, covariances, pixel = system
    same = np.arange(40) % n_distinct
    few = (mounting, ideal[same], slopes[same], points[same], covariances[same], pixel[same])
    assert converged(rows(start), *few, np.zeros((6, 6)), _SCALES)[1] != CONVERGED
