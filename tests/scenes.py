"""Synthetic scenes with ground truth: cameras in front of a facade, every number from a given rng.

World axes are NED-like (x forward, y right, z down), the facade stands across
x, bodies are FRD and look along their x axis. Nothing is rendered here: a scene
is landmarks, poses, and where the cameras see the landmarks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD

PINHOLE = Camera(640, 480, 320.0, 320.0, 319.5, 239.5)
RADIAL_TANGENTIAL = Camera(
    752, 480, 458.654, 457.296, 367.215, 248.375,
    "radial-tangential", (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)  # fmt: skip
RADIAL_TANGENTIAL_5 = Camera(
    640, 480, 410.0, 408.0, 321.3, 236.8, "radial-tangential", (-0.12, 0.05, 6e-4, -4e-4, -0.01)
)
EQUIDISTANT = Camera(
    640, 480, 260.0, 259.0, 318.2, 242.1, "equidistant", (0.01, -0.004, 0.002, -0.0005)
)
CAMERAS = (PINHOLE, RADIAL_TANGENTIAL, RADIAL_TANGENTIAL_5, EQUIDISTANT)


@dataclass(frozen=True, eq=False)
class Scene:
    """What is true, and what was seen of it.

    Attributes:
        points_world: (N, 3) landmarks, world frame, m.
        bodies: V true world_from_body poses; the first is the identity.
        mountings: V body_from_cam poses, lever arm included.
        camera: the intrinsics that all views share.
        observed_px: (N, V, 2) raw pixels with noise and wrong matches; NaN where
            the landmark is behind the camera, outside the image, or missed.
        exact_px: (N, V, 2) the same without noise and wrong matches.
        wrong: (N, V) bool, observations that were replaced by a random pixel.
        noise_px: 1-sigma of one pixel coordinate that was put in.
    """

    points_world: Array
    bodies: tuple[Pose, ...]
    mountings: tuple[Pose, ...]
    camera: Camera
    observed_px: Array
    exact_px: Array
    wrong: NDArray[np.bool_]
    noise_px: float

    @property
    def n_views(self) -> int:
        """How many cameras there are."""
        return len(self.bodies)

    @property
    def slopes(self) -> Array:
        """(N, V, 2, 2) d(pixel) / d(ideal) at the observations; NaN where unseen."""
        ideal = self.ideal
        views = range(ideal.shape[1])
        return np.stack([self.camera.pixel_slopes(ideal[:, i]) for i in views], axis=1)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, V) which landmark was observed in which view."""
        return np.asarray(np.isfinite(self.observed_px[..., 0]))

    @property
    def worlds_from_cams(self) -> list[Pose]:
        """The V true camera poses."""
        return [b @ m for b, m in zip(self.bodies, self.mountings, strict=True)]

    @property
    def ideal(self) -> Array:
        """(N, V, 2) observations as ideal image coordinates x/z, y/z."""
        flat = self.camera.ideal_from_pixels(self.observed_px.reshape(-1, 2))
        return flat.reshape(self.observed_px.shape)

    def baseline_m(self, a: int, b: int) -> float:
        """Distance between two bodies: what the swarm is told at the start."""
        return float(np.linalg.norm(self.bodies[a].translation - self.bodies[b].translation))

    def observed_again(
        self, rng: np.random.Generator, noise_px: float, outliers: float = 0.0, missed: float = 0.0
    ) -> Scene:
        """Return the same scene with new noise, wrong matches and gaps (see ``observe``)."""
        return observe(
            rng, self.points_world, self.bodies, self.mountings, self.camera,
            noise_px=noise_px, outliers=outliers, missed=missed,
        )  # fmt: skip


def observe(
    rng: np.random.Generator,
    points_world: Array,
    bodies: tuple[Pose, ...],
    mountings: tuple[Pose, ...],
    camera: Camera,
    *,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    missed: float = 0.0,
) -> Scene:
    """Look at landmarks from given poses.

    Args:
        rng: of the noise.
        points_world: (N, 3) landmarks, world frame, m.
        bodies: V world_from_body poses.
        mountings: V body_from_cam poses.
        camera: intrinsics of all views.
        noise_px: 1-sigma of one pixel coordinate.
        outliers: share of the observations replaced by a random pixel of the image.
        missed: share of the observations that are not there (NaN).
    """
    exact = np.full((len(points_world), len(bodies), 2), np.nan)
    for i, (body, mounting) in enumerate(zip(bodies, mountings, strict=True)):
        exact[:, i] = camera.project((body @ mounting).inverse().apply(points_world))
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    inside = np.all((exact >= 0.0) & (exact <= size - 1.0), axis=-1)
    exact[~inside] = np.nan
    observed = exact + noise_px * rng.standard_normal(exact.shape)
    wrong = inside & (rng.random(inside.shape) < outliers)
    observed[wrong] = (rng.random(exact.shape) * (size - 1.0))[wrong]
    gone = rng.random(inside.shape) < missed
    observed[gone] = np.nan
    return Scene(points_world, bodies, mountings, camera, observed, exact, wrong & ~gone, noise_px)


def facade_scene(
    rng: np.random.Generator,
    n_points: int = 200,
    relief_m: float = 1.5,
    *,
    n_views: int = 2,
    distance_m: float = 12.0,
    baseline_m: float = 2.0,
    turn_deg: float = 4.0,
    lever_arm_m: float = 0.1,
    camera: Camera = PINHOLE,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    missed: float = 0.0,
) -> Scene:
    """Make drones side by side in front of a building.

    Args:
        rng: everything random comes from it.
        n_points: landmarks; nearly all lie in the first view, most in the others.
        relief_m: depth of the facade, uniform; 0 is a plane (the planar twins).
        n_views: drones; the first is at the world's origin and looks along x.
        distance_m: from the first drone to the facade.
        baseline_m: between neighbours, mostly sideways.
        turn_deg: 1-sigma of each body's random turn about each axis.
        lever_arm_m: 1-sigma of the camera's random offset in its body, each axis;
            the cameras look forward, tilted by a random degree or so.
        camera: intrinsics of all views.
        noise_px, outliers, missed: see ``observe``.
    """
    mountings = tuple(
        Pose(
            BODY_FROM_CAM_FORWARD @ exp_so3(np.deg2rad(1.0) * rng.standard_normal(3)),
            lever_arm_m * rng.standard_normal(3),
        )
        for _ in range(n_views)
    )
    bodies = [Pose.identity()]
    for i in range(1, n_views):
        side = (i + 1) // 2 * (1.0 if i % 2 else -1.0)
        centre = baseline_m * (side * np.array([0.0, 1.0, 0.0]) + 0.15 * rng.standard_normal(3))
        angles = np.deg2rad(turn_deg) * rng.standard_normal(3)
        bodies.append(Pose(matrix_from_euler(*angles), centre))
    # Spread over the first image (its middle 90 %), at the facade's depth.
    pixels = np.array([camera.width_px, camera.height_px]) * (
        0.05 + 0.9 * rng.random((n_points, 2))
    )
    rays_cam = np.hstack([camera.ideal_from_pixels(pixels), np.ones((n_points, 1))])
    first = bodies[0] @ mountings[0]
    rays = rays_cam @ first.rotation.T
    x = distance_m + relief_m * (rng.random(n_points) - 0.5)
    points = first.translation + rays * ((x - first.translation[0]) / rays[:, 0])[:, None]
    return observe(
        rng, points, tuple(bodies), mountings, camera,
        noise_px=noise_px, outliers=outliers, missed=missed,
    )  # fmt: skip


def perturbed(rng: np.random.Generator, pose: Pose, sigma_m: float, sigma_rad: float) -> Pose:
    """Return a pose with a random local error: ``sigma_m`` and ``sigma_rad`` on each axis."""
    return pose.retracted(np.repeat([sigma_m, sigma_rad], 3) * rng.standard_normal(6))


def perturbed_scene_start(
    rng: np.random.Generator, scene: Scene, sigma_m: float, sigma_rad: float, sigma_point_m: float
) -> tuple[tuple[Pose, ...], Array]:
    """Return a wrong first estimate of (bodies, points); the first body stays exact (gauge)."""
    bodies = (
        scene.bodies[0],
        *(perturbed(rng, body, sigma_m, sigma_rad) for body in scene.bodies[1:]),
    )
    noise = sigma_point_m * rng.standard_normal(scene.points_world.shape)
    return bodies, scene.points_world + noise


def random_rotation(rng: np.random.Generator) -> Array:
    """Return a (3, 3) rotation, uniform over SO(3)."""
    return Pose.from_quaternion(rng.standard_normal(4), np.zeros(3)).rotation
