"""How some views lie to each other, as their patches have it, and where they are by that.

A small bundle adjustment: each patch has one unknown, its inverse depth in the first view, all are
about as far as their parts of the scene are, and the other views lie to the first one as they are
believed to, more or less. What they are off together, against the rest of the world, patches cannot
tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose, adjoint
from vcl_companion.geometry.rotation import Array, orthonormalized
from vcl_companion.mapping.given_depths import (
    MOST_AT_ONCE,
    NOISE_PX,
    DepthParts,
    SceneDepth,
    moved_by,
    projected,
)
from vcl_companion.vision.information import covariance_of

# Farther from where it should be, px, a patch is another spot: loosely, until the views are placed.
_LIMITS_PX = (8.0, 4.0, 2.0, 1.5, 1.5)
# A residual of this halves a patch's weight.
_CAUCHY_PX = 0.5
# Patches err alike, through the lens, the light, the encoder: as so many count for one. Of what is
# found by them less is believed than is made of them.
_ALIKE, _TOLD_ALIKE = 9.0, 100.0
# Smallest eigenvalue of a matrix with ones on its diagonal; less is rounding.
_SINGULAR = 1e-14


@dataclass(frozen=True, eq=False)
class Relative:
    """How V - 1 views lie to the first one, as patches have it.

    Attributes:
        inverse_depths: (N,) of the patches in the first view, 1/m.
        step: (6 (V - 1),) by which they lie otherwise than believed, local perturbations.
        covariance: (6 (V - 1), 6 (V - 1)) of what they are off to the first view now.
        parts: how far the first one's scene is, as far as that is known now.
    """

    inverse_depths: Array
    step: Array
    covariance: Array
    parts: DepthParts


@dataclass(frozen=True, eq=False)
class Placement:
    """Where V views are.

    Attributes:
        bodies: their poses.
        covariance: (6V, 6V) of these together, local.
        held: which one of them stayed where it was.
        by_before: (6V, 6V) what each is off by what each was off before; the rest is its own.
    """

    bodies: list[Pose]
    covariance: Array
    held: int
    by_before: Array


def relative_map(bodies: list[Pose]) -> Array:
    """Return (6 (V - 1), 6V) how views lie to the first one, by what each is off, both local."""
    v = len(bodies)
    out = np.eye(6 * v)[6:]
    for i, body in enumerate(bodies[1:]):
        out[6 * i : 6 * i + 6, :6] = -adjoint(body.inverse() @ bodies[0])
    return out


def adjusted(
    observed_px: Array,
    inverse_depths: Array,
    bodies: list[Pose],
    body_from_cam: Pose,
    camera: Camera,
    scene: SceneDepth,
    parts: DepthParts,
    covariance: Array,
) -> Relative:
    """Find how views lie to the first one, and the depths, that patches agree with best.

    Args:
        observed_px: (N, V, 2) raw px, NaN where not found; all are in view 0.
        inverse_depths: (N,) in view 0, to begin with, 1/m.
        bodies: V poses, as they are believed to be.
        body_from_cam: the camera's mounting, the same in all.
        camera: its intrinsics.
        scene: within which depths lie.
        parts: of view 0, where the patches are: about where depths are expected.
        covariance: (6 (V - 1), 6 (V - 1)) of what the others are off to the first one.

    Raises:
        ValueError: the covariance is singular.
    """
    n, v = observed_px.shape[:2]
    ideal = camera.ideal_from_pixels(observed_px[:, 0])
    rays = np.column_stack([ideal, np.ones(n)])
    cam_from_body = adjoint(body_from_cam.inverse())
    # The poses, and what the parts' inverse depths are off.
    shares, expected, certain = parts.shares, parts.expected(), 1.0 / parts.relief**2
    believed = block_diag(_inverse(covariance), _inverse(parts.covariance))
    r, step = scene.within(inverse_depths), np.zeros(len(believed))
    n_poses = 6 * (v - 1)
    of_parts = slice(n_poses, None)
    for limit_px in _LIMITS_PX:
        off_scene = expected + shares @ step[of_parts] - np.log(r)
        r_information, r_pull = np.full(n, certain), certain * off_scene
        seen, pull = np.zeros_like(believed), np.zeros(len(believed))
        seen[of_parts, of_parts] = certain * shares.T @ shares
        pull[of_parts] = -certain * off_scene @ shares
        crossed = np.zeros((n, len(believed)))
        crossed[:, of_parts] = -certain * shares
        for i in range(1, v):
            own = slice(6 * i - 6, 6 * i)
            body = bodies[i].retracted(step[own])
            there = projected(rays, r, bodies[0] @ body_from_cam, body @ body_from_cam, camera)
            off = observed_px[:, i] - there.pixels
            with np.errstate(invalid="ignore"):
                squared = (off**2).sum(axis=1)
                fits = squared < limit_px**2
            weight = np.where(fits, NOISE_PX**-2 / (1.0 + squared / _CAUCHY_PX**2), 0.0)
            off = np.where(fits[:, None], off, 0.0)
            by_depth = np.where(fits[:, None], there.by_inverse_depth * r[:, None], 0.0)
            by_pose = np.where(
                fits[:, None, None],
                -there.by_point @ moved_by(there.points_cam) @ cam_from_body,
                0.0,
            )
            weighed = weight[:, None, None] * by_pose
            r_information += weight * (by_depth**2).sum(axis=1)
            r_pull += weight * (by_depth * off).sum(axis=1)
            seen[own, own] = np.einsum("nki,nkj->ij", weighed, by_pose)
            pull[own] += np.einsum("nki,nk->i", weighed, off)
            crossed[:, own] = np.einsum("nki,nk->ni", weighed, by_depth)
        seen -= crossed.T @ (crossed / r_information[:, None])
        pull -= crossed.T @ (r_pull / r_information)
        taken = np.linalg.solve(believed + seen / _ALIKE, pull / _ALIKE - believed @ step)
        step = step + taken
        nearer = np.clip((r_pull - crossed @ taken) / r_information, -MOST_AT_ONCE, MOST_AT_ONCE)
        r = scene.within(r * np.exp(nearer))
    left = _inverse(believed + seen / _TOLD_ALIKE)
    found = replace(
        parts,
        typical=parts.typical + step[of_parts],
        covariance=left[of_parts, of_parts],
    )
    return Relative(r, step[:n_poses], left[:n_poses, :n_poses], found)


def held_by_one(
    bodies: list[Pose], covariance: Array, learnt: Relative, scene: SceneDepth
) -> Placement:
    """Place views by the one of them that is known best, and by how the others lie to it.

    Not by all of them: found by much the same landmarks, they do not err each by itself, and
    where they disagree it is some of them that are wrong.

    Args:
        bodies: V poses, as they were believed to be.
        covariance: (6V, 6V) of them together, local.
        learnt: how they lie to the first one.
        scene: how far what they show is: by it turning and moving are compared.

    Raises:
        ValueError: the covariance is singular.
    """
    v = len(bodies)
    held = int(np.argmin(scene.vagueness(covariance)))
    own = slice(6 * held, 6 * held + 6)
    steps = np.concatenate([np.zeros(6), learnt.step]).reshape(v, 6)
    lying = [body.retracted(step) for body, step in zip(bodies, steps, strict=True)]
    moved = bodies[held] @ lying[held].inverse()
    # From map to map poses are made of poses: what rounding leaves would grow each time.
    poses = [
        Pose(orthonormalized(pose.rotation), pose.translation)
        for pose in (moved @ body for body in lying)
    ]
    # What each is off: as the first one is, and by how it lies to that; the first as the held is.
    by_first = np.vstack([adjoint(body.inverse() @ poses[0]) for body in poses])
    by_lying = np.vstack([np.zeros((6, 6 * v - 6)), np.eye(6 * v - 6)])
    to_held = adjoint(poses[0].inverse() @ poses[held])
    by_lying = by_lying - by_first @ to_held @ by_lying[own]
    # What is not learnt of how they lie to each other, as a scale is not, is off as it was before,
    # and with what else that has to do with.
    relative = relative_map(bodies)
    stays = learnt.covariance @ _inverse(relative @ covariance @ relative.T)
    by_before = by_lying @ stays @ relative
    by_before[:, own] += by_first @ to_held
    own_noise = learnt.covariance - stays @ learnt.covariance
    after = by_before @ covariance @ by_before.T + by_lying @ own_noise @ by_lying.T
    return Placement(poses, 0.5 * (after + after.T), held, by_before)


def _inverse(covariance: Array) -> Array:
    inverse = covariance_of(0.5 * (covariance + covariance.T), _SINGULAR)
    if inverse is None:
        raise ValueError("what views are off to each other is no covariance")
    return inverse
