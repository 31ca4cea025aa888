"""Every compiled kernel once, so that no frame has to wait for the compiler.

The first time on a machine this takes half a minute and more, afterwards a
second: the code is kept on disk (``compiled``).
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import pose_errors, pose_kernels
from vcl_companion.vision.absolute_pose import resect
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    Views,
    adjust,
    leverages,
    matrices_of,
    observations_of,
    relative_sigmas,
)
from vcl_companion.vision.essential import sampson_px
from vcl_companion.vision.features import Features
from vcl_companion.vision.guided_pairs import match_epipolar
from vcl_companion.vision.hamming import hamming_index, nearest_two
from vcl_companion.vision.joint_kernels import joined, seen_aside, without_points
from vcl_companion.vision.patch_choice import ChoiceRules, choose_anchors
from vcl_companion.vision.patch_tables import Anchors, keyframe_images, lens_of, pyramid_of
from vcl_companion.vision.patches import AlignRules, align_patches
from vcl_companion.vision.relative_pose import essential_candidates
from vcl_companion.vision.schur import carried
from vcl_companion.vision.surface_kernels import inclinations
from vcl_companion.vision.texture import textures
from vcl_companion.vision.triangulation import ray_angles


def warm_up() -> None:
    """Search poses in a small scene without noise, adjust it, track a patch."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (40, 2)), rng.uniform(4.0, 8.0, 40)])
    moved = points + np.array([1.0, 0.2, 0.1])
    ideal_a, ideal_b = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    essential_candidates(ideal_a, ideal_b, 320.0, rng)
    resect(ideal_b, points, 320.0, rng)
    carried(np.ones((1, 3, 6), np.float32), np.eye(6), np.zeros(1, np.int64))
    _join(points)
    descriptors = np.asarray(rng.integers(0, 255, (40, 61)), dtype=np.uint8)
    nearest_two(descriptors, hamming_index(descriptors, np.arange(40)))
    still = Features(320.0 * ideal_a, descriptors)
    b_from_a = Pose(np.eye(3), np.array([1.0, 0.2, 0.1]))
    sampson_px(b_from_a, ideal_a, ideal_b, 320.0)
    match_epipolar(still, still, ideal_a, ideal_b, b_from_a, (0.1, 0.3), 320.0)
    _adjust(points)
    _track(rng)
    for model in ("radial-tangential", "equidistant"):
        lens = Camera(640, 480, 320.0, 320.0, 320.0, 240.0, model, (-0.1, 0.0, 0.0, 0.0))
        lens.pixel_slopes(lens.ideal_from_pixels(lens.pixels_from_ideal(ideal_a)))


def _join(points: Array) -> None:
    """Eliminate points that one view has seen once."""
    n = len(points)
    first, view = observations_of(np.ones((n, 1), dtype=np.bool_))
    here = matrices_of([Pose.identity()])
    seen = points[:, :2] / points[:, 2:], np.zeros((n, 2, 1))
    seen_aside(points, np.zeros((1, 3)), first, view)
    of_views, _, crosses, view_pulls, point_pulls = joined(
        points, here, here, first, view, np.tile(np.eye(2), (n, 1, 1)), *seen
    )
    inverses, levers = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3, 6), np.float32)
    without_points(first, view, crosses, inverses, point_pulls, of_views, view_pulls, levers)


def _adjust(points: Array) -> None:
    """Adjust two views of points, and fit planes to these."""
    bodies = (Pose.identity(), Pose(np.eye(3), np.array([1.0, 0.2, 0.1])))
    ideal = np.stack([(points - b.translation)[:, :2] / points[:, 2:] for b in bodies], axis=1)
    views = Views(
        bodies=bodies,
        mountings=(Pose.identity(),) * 2,
        slopes=np.tile(320.0 * np.eye(2), (len(points), 2, 1, 1)),
        ideal=ideal,
        points=points,
        distances=(Distance(0, 1, 1.0, 0.01),),
    )
    adjust(views, BundleOptions(max_iterations=2))
    relative_sigmas(views)
    leverages(views, np.eye(12))
    ray_angles(list(bodies), points, np.ones((len(points), 2), dtype=np.bool_))
    n = len(points)
    near = np.tile(np.arange(4, dtype=np.int64), (n, 1))
    depth, far = points[:, 2], np.ones((n, 4))
    inclinations(np.ascontiguousarray(ideal[:, 0]), 1.0 / depth, 0.01 / depth, near, far, 40.0, 1.0)


def _track(rng: np.random.Generator) -> None:
    """Find the patches of a small image in itself, and refine the pose by them."""
    camera, still = Camera(96, 96, 80.0, 80.0, 47.5, 47.5), Pose.identity()
    image = np.asarray(rng.integers(0, 255, (96, 96)), dtype=np.uint8)
    pixels = rng.uniform(30.0, 60.0, (20, 2))
    n, ideal = len(pixels), camera.ideal_from_pixels(pixels)
    flat = np.zeros((n, 2))
    slopes = np.tile([1 / 80.0, 0.0, 0.0, 1 / 80.0], (n, 1))
    anchors = Anchors(
        first=np.arange(n + 1, dtype=np.int64),
        landmark=np.arange(n, dtype=np.int64),
        keyframe=np.zeros(n, dtype=np.int64),
        planes=np.column_stack([ideal, np.ones(n), flat, slopes]),
        pixels=pixels,
        points_world=np.column_stack([ideal, np.ones(n)]),
        own=np.zeros((n, 3)),
        spread=np.tile([1e-6, 0.0, 0.0, 1e-6, 0.0, 1e-6], (n, 1)),
        texture=np.tile([1e5, 0.0, 1e5], (n, 1)),
        images=keyframe_images([pyramid_of(image)], [still]),
    )
    lens, frame = lens_of(camera), pyramid_of(image)
    textures(image, pixels, 4)
    rules = ChoiceRules(40.0, 4.0, 0.05, 0.5, 0.03, 1.5, 3.5)
    rows, *_ = choose_anchors(anchors, lens, still, still, np.eye(6), rules, n, 6.0)
    found = align_patches(anchors, rows, frame, lens, still, np.ones(n), 0, AlignRules())
    pose = np.ascontiguousarray(still.matrix()[:3])
    system = (
        found.ideal,
        found.slopes,
        anchors.points_world[rows],
        anchors.spread[rows],
        found.noise + found.misplaced + np.array([1.0, 0.0, 1.0]),
    )
    pose_kernels.converged(pose, pose, *system, np.zeros((6, 6)), np.ones(1))
    supported = pose_kernels.supported(pose, pose, *system, 18.4)
    _, _, j_poses, j_points, roots, weights, _ = supported
    pose_errors.gained(
        np.eye(6),
        j_poses,
        j_points,
        roots,
        weights,
        found.noise,
        found.misplaced,
        anchors.own[rows],
        rows,
        np.zeros((n, 3, 6), np.float32),
    )
