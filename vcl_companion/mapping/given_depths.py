"""How far patches of one view are away, by where other views of given poses show them.

The poses are not adjusted: whatever they are off by, depths are off by with them. How, is told
besides (the levers), so that who rests on such landmarks knows what all have in common. Where
views are too close together to tell, a depth stays about what the scene's is there. What lies
side by side is about as far away, and so wrong together: that is told as well. As if each
depth were wrong by itself, hundreds would seem to tell turning and moving apart that do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose, adjoint
from vcl_companion.geometry.rotation import Array

NOISE_PX = 0.2
"""What a patch that was found is off, 1 sigma."""
# Farther from where the depth puts it, px, a patch is another spot: loosely, until it is settled.
_LIMITS_PX = (2.0, 1.5)
# How far a depth may come to lie beyond the scene's, times.
_BEYOND = 2.0
MOST_AT_ONCE = 0.7
"""No depth changes by more in one step of an adjustment, logarithm."""
# Parts of an image across and down: corners of a grid over it.
_PARTS = (4, 3)
# A patch lies so far before or behind what is about it, logarithm of distances, 1 sigma. Taken for
# much more than it is, what noise does to depths that hardly any parallax tells would pass for
# relief, and who moves over relief that is not there seems not to move.
_RELIEF = 0.3


@dataclass(frozen=True)
class SceneDepth:
    """What is known of a scene's inverse depths beforehand, 1/m.

    Attributes:
        least, largest: none lies beyond.
        typical: the median.
        spread: 1 sigma of a part of the image about it, logarithm: the same at any scale.
        off: 1 sigma of what that is off, the same for all, logarithm.
    """

    least: float
    largest: float
    typical: float
    spread: float
    off: float

    def within(self, inverse_depths: Array) -> Array:
        """Return (N,) inverse depths, 1/m, none of them far beyond the scene's."""
        return np.clip(inverse_depths, self.least / _BEYOND, self.largest * _BEYOND)

    def parts(self, pixels: Array, camera: Camera) -> DepthParts:
        """Return what is known beforehand of the parts of a view that show (N, 2) pixels."""
        size_px = camera.width_px, camera.height_px
        across, down = (
            np.maximum(1.0 - np.abs(at[:, None] * ((n - 1) / size) - np.arange(n)), 0.0)
            for at, size, n in zip(pixels.T, size_px, _PARTS, strict=True)
        )
        k = _PARTS[0] * _PARTS[1]
        shares = (across[:, :, None] * down[:, None, :]).reshape(len(pixels), k)
        covariance = np.full((k, k), self.off**2) + np.eye(k) * self.spread**2
        return DepthParts(shares, np.full(k, np.log(self.typical)), covariance, _RELIEF)

    def vagueness(self, covariance: Array) -> Array:
        """Return (V,) how vague poses are, rad^2: moving counts by how far the scene is.

        Args:
            covariance: (6V, 6V) of V poses, local.
        """
        worth = np.repeat([self.typical, 1.0], 3) ** 2
        return np.asarray(np.diag(covariance).reshape(-1, 6) @ worth)


@dataclass(frozen=True, eq=False)
class DepthParts:
    """How far what a view shows is, by K parts of it; each goes over into those beside it.

    Attributes:
        shares: (N, K) of the parts in where N patches are; they sum to 1.
        typical: (K,) of the parts, logarithms of 1/m.
        covariance: (K, K) of these.
        relief: 1 sigma of a patch about what its parts say, logarithm.
    """

    shares: Array
    typical: Array
    covariance: Array
    relief: float

    def expected(self) -> Array:
        """Return (N,) logarithms of the patches' inverse depths, 1/m."""
        return np.asarray(self.shares @ self.typical)


@dataclass(frozen=True, eq=False)
class Depths:
    """The depths of N patches of view 0 of V.

    Attributes:
        points: (N, 3) world, m.
        covariance: (N, 3, 3) of each were the poses exact, m^2.
        lever: (N, 3, 6V) a point's error per error of the bodies' poses, local perturbations.
        by_parts: (N, 3, K) how far it moves by K errors of the scene's parts, 1 sigma each, m.
        fits: (N, V) where the patch was found and lies as its depth says.
    """

    points: Array
    covariance: Array
    lever: Array
    by_parts: Array
    fits: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Projected:
    """N patches in another view.

    Attributes:
        points_cam: (N, 3) in its camera's axes, m.
        pixels: (N, 2) raw px.
        by_inverse_depth: (N, 2) px per 1/m.
        by_point: (N, 2, 3) px per m.
    """

    points_cam: Array
    pixels: Array
    by_inverse_depth: Array
    by_point: Array


def depths_of(
    observed_px: Array,
    inverse_depths: Array,
    bodies: list[Pose],
    body_from_cam: Pose,
    camera: Camera,
    scene: SceneDepth,
    parts: DepthParts,
) -> Depths:
    """Find the depths that agree best with where other views show the patches.

    Args:
        observed_px: (N, V, 2) raw px, NaN where not found; all are in view 0.
        inverse_depths: (N,) in view 0, to begin with, 1/m.
        bodies: V poses.
        body_from_cam: the camera's mounting, the same in all.
        camera: its intrinsics.
        scene: within which depths lie.
        parts: of view 0, where the patches are: about where depths are expected.
    """
    cams = [body @ body_from_cam for body in bodies]
    ideal = camera.ideal_from_pixels(observed_px[:, 0])
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    r, weight = inverse_depths, 1.0 / NOISE_PX**2
    certain, expected = 1.0 / parts.relief**2, parts.expected()
    fits = np.zeros(observed_px.shape[:2], dtype=bool)
    fits[:, 0] = True
    for limit_px in _LIMITS_PX:
        r = scene.within(r)
        off = expected - np.log(r)
        shown = [projected(rays, r, cams[0], cam, camera) for cam in cams[1:]]
        information, pull = np.full(len(r), certain), certain * off
        for i, there in enumerate(shown, start=1):
            missed = observed_px[:, i] - there.pixels
            with np.errstate(invalid="ignore"):
                fits[:, i] = np.linalg.norm(missed, axis=1) < limit_px
            slope = np.where(fits[:, [i]], there.by_inverse_depth * r[:, None], 0.0)
            information += weight * (slope**2).sum(axis=1)
            pull += weight * (slope * np.where(fits[:, [i]], missed, 0.0)).sum(axis=1)
        r = r * np.exp(np.clip(pull / information, -MOST_AT_ONCE, MOST_AT_ONCE))
    # The last step is the smallest; what it was taken from is as good for the errors.
    lever = _lever(
        rays, r, shown, fits, weight * r**2 / information, cams, adjoint(body_from_cam.inverse())
    )
    # What the depths' logarithms move.
    moved = r[:, None] * _by_inverse_depth(rays, r, cams[0])
    covariance = np.einsum("ni,nj->nij", moved, moved) / information[:, None, None]
    points = cams[0].apply(rays / r[:, None])
    by_part = (certain / information)[:, None] * parts.shares @ np.linalg.cholesky(parts.covariance)
    by_parts = moved[:, :, None] * by_part[:, None, :]
    return Depths(points, covariance, lever, by_parts, fits)


def projected(rays: Array, r: Array, a: Pose, b: Pose, camera: Camera) -> Projected:
    """Return where patches of view a appear in view b, by (N, 3) rays and inverse depths."""
    b_from_a = b.inverse() @ a
    points = b_from_a.apply(rays / r[:, None])
    with np.errstate(all="ignore"):
        z = points[:, 2]
        ideal = points[:, :2] / z[:, None]
        by_point = np.zeros((len(r), 2, 3))
        by_point[:, 0, 0] = by_point[:, 1, 1] = 1.0 / z
        by_point[:, :, 2] = -ideal / z[:, None]
        by_point = camera.pixel_slopes(ideal) @ by_point
        moved = -(rays / (r**2)[:, None]) @ b_from_a.rotation.T
        by_inverse_depth = np.einsum("nij,nj->ni", by_point, moved)
    return Projected(points, camera.project(points), by_inverse_depth, by_point)


def _by_inverse_depth(rays: Array, r: Array, world_from_cam: Pose) -> Array:
    """Return (N, 3) how points move in the world by their inverse depth."""
    return np.asarray(-(rays / (r**2)[:, None]) @ world_from_cam.rotation.T)


def _lever(
    rays: Array,
    r: Array,
    shown: list[Projected],
    fits: NDArray[np.bool_],
    gain: Array,
    cams: list[Pose],
    cam_from_body: Array,
) -> Array:
    """Return ``Depths.lever``: a depth makes up for what its view and the others are off."""
    n, v = fits.shape
    rigid = moved_by(rays / r[:, None]) @ cam_from_body
    inverse_depth = np.zeros((n, 6 * v))
    for i, there in enumerate(shown, start=1):
        slope = np.where(fits[:, [i]], gain[:, None] * there.by_inverse_depth, 0.0)
        along = np.where(fits[:, i, None, None], slope[:, None, :] @ there.by_point, 0.0)
        rotation = (cams[i].inverse() @ cams[0]).rotation
        inverse_depth[:, :6] -= (along @ rotation @ rigid)[:, 0]
        own = slice(6 * i, 6 * i + 6)
        inverse_depth[:, own] += (along @ moved_by(there.points_cam) @ cam_from_body)[:, 0]
    lever = _by_inverse_depth(rays, r, cams[0])[:, :, None] * inverse_depth[:, None, :]
    lever[:, :, :6] += cams[0].rotation @ rigid
    return np.asarray(lever)


def moved_by(points: Array) -> Array:
    """Return (N, 3, 6) how points fixed to a frame move in it by a local perturbation of it."""
    out = np.zeros((len(points), 3, 6))
    x, y, z = points.T
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1.0
    out[:, 0, 4], out[:, 0, 5] = z, -y
    out[:, 1, 3], out[:, 1, 5] = -z, x
    out[:, 2, 3], out[:, 2, 4] = y, -x
    return out
