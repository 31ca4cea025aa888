"""Values that the wire tests encode: fixed ones for the golden bytes, random ones for the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.landmark_map import (
    MAX_JOINED,
    JoinedMap,
    Keyframe,
    KnownDistance,
    LandmarkMap,
)
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.pose_messages import PoseProposal

CAMERAS = (
    Camera(640, 480, 400.5, 401.25, 319.5, 239.5),
    Camera(752, 480, 458.654, 457.296, 367.215, 248.375, "radial-tangential", (-0.28, 0.07, 0, 0)),
    Camera(1920, 1200, 900.0, 901.0, 960.1, 600.2, "radial-tangential", (-0.3, 0.1, 0, 0, 0.01)),
    Camera(848, 800, 285.7, 286.0, 424.0, 400.0, "equidistant", (-0.01, 0.04, -0.04, 0.007)),
)


def random_pose(rng: np.random.Generator, size_m: float = 50.0) -> Pose:
    return Pose(exp_so3(rng.uniform(-3.0, 3.0, 3)), rng.uniform(-size_m, size_m, 3))


def random_map(
    rng: np.random.Generator, n_landmarks: int, n_keyframes: int, seen_share: float = 0.7
) -> LandmarkMap:
    """A map as the codec sees it: nothing in it has to fit together geometrically."""
    cameras = [CAMERAS[int(rng.integers(len(CAMERAS)))] for _ in range(n_keyframes)]
    keyframes = tuple(
        Keyframe(
            drone_id=int(rng.integers(1, 251)),
            captured_at_ns=int(rng.integers(0, 1 << 62)),
            world_from_body=random_pose(rng),
            body_from_cam=random_pose(rng, 0.3),
            camera=camera,
            image_bytes=rng.bytes(int(rng.integers(1, 200))),
        )
        for camera in cameras
    )
    sizes_px = np.array([(camera.width_px, camera.height_px) for camera in cameras])
    observed_px = rng.uniform(0.0, 1.0, (n_landmarks, n_keyframes, 2)) * (sizes_px - 1)
    observed_px[rng.uniform(size=(n_landmarks, n_keyframes)) > seen_share] = np.nan
    distances = (KnownDistance(0, n_keyframes - 1, 3.456, 0.01),) if n_keyframes > 1 else ()
    parent = rng.bytes(8) if rng.uniform() < 0.5 else b""
    world = rng.bytes(8) if parent and rng.uniform() < 0.7 else b""
    n_joined = int(rng.integers(MAX_JOINED + 1)) if world and rng.uniform() < 0.5 else 0
    return LandmarkMap(
        keyframes=keyframes,
        points_world=rng.uniform(-30.0, 60.0, (n_landmarks, 3)),
        observed_px=observed_px,
        pixel_noise_px=float(rng.uniform(0.05, 2.0)),
        detectors=[("akaze",), ("sift",), ("akaze", "sift"), ("orb",)][int(rng.integers(4))],
        distances=distances,
        parent=parent,
        world=world,
        joined=tuple(random_joined(rng) for _ in range(n_joined)),
    )


def scene_map(rng: np.random.Generator, n_landmarks: int, n_keyframes: int) -> LandmarkMap:
    """A map as a flight leaves it: cameras abreast, landmarks ahead, seen to 0.1 px."""
    bodies = [
        Pose(exp_so3(rng.normal(0.0, 0.02, 3)), np.array([*rng.normal(0.0, 0.2, 2), 1.5 * k]))
        for k in range(n_keyframes)
    ]
    camera = CAMERAS[0]
    keyframes = tuple(
        Keyframe(k % 3 + 1, 200_000_000 * k, body, Pose.identity(), camera, f"image {k}".encode())
        for k, body in enumerate(bodies)
    )
    z = rng.uniform(20.0, 40.0, n_landmarks) + 1.5 * n_keyframes
    points = np.column_stack([rng.uniform(-0.5, 0.5, (n_landmarks, 2)) * z[:, None], z])
    pixels = np.stack([camera.project(body.inverse().apply(points)) for body in bodies], axis=1)
    pixels += 0.1 * rng.standard_normal(pixels.shape)
    inside = ((pixels >= 0.0) & (pixels <= (639.0, 479.0))).all(axis=2)
    pixels[~inside | (rng.uniform(size=inside.shape) < 0.2)] = np.nan
    return LandmarkMap(
        keyframes=keyframes,
        points_world=points,
        observed_px=pixels,
        pixel_noise_px=0.1,
        detectors=("akaze", "sift"),
        distances=(),
        parent=b"",
    )


def random_joined(rng: np.random.Generator) -> JoinedMap:
    pose, scale = random_pose(rng), float(rng.uniform(0.9, 1.1))
    return JoinedMap(rng.bytes(8), rng.bytes(8), Similarity(pose.rotation, pose.translation, scale))


def small_map() -> LandmarkMap:
    """Three landmarks in two keyframes, all numbers written out."""
    nan = float("nan")
    keyframes = tuple(
        Keyframe(
            drone_id=drone,
            captured_at_ns=1_000_000_000 * drone,
            world_from_body=Pose.from_quaternion(
                np.array([1.0, 0.0, 0.0, 0.5]), np.array([0.0, 2.0 * drone, -1.5])
            ),
            body_from_cam=Pose.from_quaternion(
                np.array([0.5, 0.5, 0.5, 0.5]), np.array([0.1, 0.0, 0.05])
            ),
            camera=CAMERAS[drone - 1],
            image_bytes=f"image {drone}".encode(),
        )
        for drone in (1, 2)
    )
    return LandmarkMap(
        keyframes=keyframes,
        points_world=np.array([[10.0, -1.0, 0.5], [12.5, 0.0, -2.25], [9.75, 3.0, 1.0]]),
        observed_px=np.array(
            [
                [[100.0, 200.5], [120.25, 201.0]],
                [[0.0, 0.0], [nan, nan]],
                [[639.0, 479.0], [300.0, 400.75]],
            ]
        ),
        pixel_noise_px=0.25,
        detectors=("akaze",),
        distances=(KnownDistance(0, 1, 2.0, 0.01),),
        parent=bytes(range(8)),
    )


def small_merged_map() -> LandmarkMap:
    """The small map, and two that were merged into it."""
    turn = Pose.from_quaternion(np.array([0.8, 0.0, 0.0, 0.6]), np.array([3.0, -40.5, 2.25]))
    there = Similarity(turn.rotation, turn.translation, 1.01)
    return replace(
        small_map(),
        world=b"of first",
        joined=(
            JoinedMap(b"revision", b"of other", Similarity.identity()),
            JoinedMap(b"another!", b"a branch", there),
        ),
    )


def small_frame() -> FrameAnswer:
    return FrameAnswer(
        drone_id=2,
        request_id=77,
        captured_at_ns=123_456_789_012,
        frame_age_s=0.25,
        ned_from_body=np.array([0.8, 0.0, 0.0, 0.6]),
        body_from_cam=Pose.from_quaternion(
            np.array([0.5, 0.5, 0.5, 0.5]), np.array([0.1, 0.0, 0.05])
        ),
        camera=CAMERAS[3],
        image_bytes=b"an image",
    )


def small_proposal() -> PoseProposal:
    root = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) + 0.005 * np.tri(6)
    pose = Pose.from_quaternion(np.array([0.8, 0.0, 0.6, 0.0]), np.array([12.5, -3.25, -40.0]))
    return PoseProposal.of(77, bytes(range(8)), pose, root @ root.T)
