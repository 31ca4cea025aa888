"""Images of a ``World`` through a calibrated camera, geometrically exact.

A rectangle's texture coordinates over its depth, and one over its depth, are
linear in the ideal image coordinates (x/z, y/z), so every sample is solved in
closed form: which rectangle is nearest, then where on it the sample lies. Lens
distortion costs nothing: a distorted camera only puts its samples elsewhere.

Pixel (0, 0) is the centre of the top-left pixel; with ``supersampling`` S, the
S x S samples of a pixel stand evenly around its centre, so averaging them
moves nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl import render_kernels as kernels
from sitl.world import SKY, Grey, Texture, World
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose

Floats = kernels.Floats

_NEAR_M = 0.02
_SKY_HALF_SPAN = 5.0


@dataclass(frozen=True)
class Imaging:
    """How light becomes grey levels.

    Attributes:
        supersampling: samples per pixel and axis.
        blur_px: sigma of the lens's point spread.
        noise_levels: sigma of the sensor's white noise, grey levels of 255.
        gain: exposure against the nominal one.
        vignetting: share of the light lost in the corners.
    """

    supersampling: int = 2
    blur_px: float = 0.5
    noise_levels: float = 2.0
    gain: float = 1.0
    vignetting: float = 0.0

    def __post_init__(self) -> None:
        if not 1 <= self.supersampling <= 8:
            raise ValueError("supersampling must be 1 to 8")
        if min(self.blur_px, self.noise_levels, self.vignetting) < 0.0 or not self.gain > 0.0:
            raise ValueError("blur, noise and vignetting must not be negative, gain positive")


@dataclass(frozen=True, eq=False)
class DepthImage:
    """What each pixel's centre looks at.

    Attributes:
        depth_m: (H, W) camera z, m; inf for sky.
        surface: (H, W) index into ``World.surfaces``, or ``SKY``.
    """

    depth_m: Floats
    surface: NDArray[np.int16]


class _Samples:
    """The rays of a camera: where its samples lie in the ideal image plane."""

    def __init__(self, camera: Camera, per_pixel: int) -> None:
        self.shape = (camera.height_px * per_pixel, camera.width_px * per_pixel)
        rows = (np.arange(self.shape[0]) + 0.5) / per_pixel - 0.5
        columns = (np.arange(self.shape[1]) + 0.5) / per_pixel - 0.5
        if any(camera.distortion) or camera.distortion_model == "equidistant":
            pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
            ideal = camera.ideal_from_pixels(pixels)
            if not np.all(np.isfinite(ideal)):
                raise ValueError("the distortion cannot be inverted all over the image")
        else:
            x, y = np.meshgrid(
                (columns - camera.cx_px) / camera.fx_px, (rows - camera.cy_px) / camera.fy_px
            )
            ideal = np.stack([x, y], axis=-1)
        self.x, self.y = np.moveaxis(ideal.reshape(*self.shape, 2).astype(np.float32), 2, 0).copy()
        self.of_columns = self.x.min(axis=0), self.x.max(axis=0)
        self.of_rows = self.y.min(axis=1), self.y.max(axis=1)
        # One sample's area on the ideal plane, taken at the principal point.
        self.spacing = 1.0 / (camera.focal_px * per_pixel)


class Renderer:
    """Renders one world through one camera; keeps the camera's rays between frames."""

    def __init__(self, world: World, camera: Camera, options: Imaging | None = None) -> None:
        """Prepare the rays.

        Raises:
            ValueError: the lens distortion has no inverse somewhere in the image.
        """
        self._world = world
        self._camera = camera
        self._options = options or Imaging()
        self._fine = _Samples(camera, self._options.supersampling)
        self._centres = _Samples(camera, 1)
        surfaces = world.surfaces
        self._corners = np.array(
            [[s.point(u, v) for u, v in _corners_m(s.width_m, s.height_m)] for s in surfaces]
        ).reshape(-1, 4, 3)
        self._outward = np.array([s.outward for s in surfaces]).reshape(-1, 3)
        axes = [np.column_stack([s.right, s.down]) for s in surfaces]
        self._axes = np.array(axes).reshape(-1, 3, 2)
        sizes = [(s.width_m, s.height_m) for s in surfaces]
        self._sizes = np.array(sizes, dtype=np.float32).reshape(-1, 2)
        n_holes = [0, *(len(s.holes) for s in surfaces)]
        self._first_hole = np.cumsum(n_holes, dtype=np.int64)
        holes = [np.zeros((0, 4)), *(s.holes for s in surfaces)]
        self._holes = np.concatenate(holes).astype(np.float32)

    def render(self, world_from_cam: Pose, rng: np.random.Generator | None = None) -> Grey:
        """Take a picture.

        Args:
            world_from_cam: the camera's pose, optical axes.
            rng: draws the sensor's noise; None takes a picture without noise.

        Returns:
            (H, W) grey image.
        """
        options = self._options
        _, surface = self._nearest(self._fine, world_from_cam)
        light = self._shade(surface, world_from_cam)
        if options.blur_px > 0.0:
            light = np.asarray(
                cv2.GaussianBlur(light, (0, 0), options.blur_px * options.supersampling),
                dtype=np.float32,
            )
        size = (self._camera.width_px, self._camera.height_px)
        image = np.asarray(cv2.resize(light, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        image *= self._sensitivity()
        if rng is not None and options.noise_levels > 0.0:
            noise = rng.standard_normal(image.shape, dtype=np.float32)
            image += np.float32(options.noise_levels) * noise
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def depth(self, world_from_cam: Pose) -> DepthImage:
        """Return the exact depth and surface at every pixel's centre."""
        inverse_depth, surface = self._nearest(self._centres, world_from_cam)
        with np.errstate(divide="ignore"):
            return DepthImage(1.0 / inverse_depth, surface)

    def _sensitivity(self) -> Floats:
        """Return the (H, W) factor from light to grey levels: exposure and vignetting."""
        x, y = self._centres.x, self._centres.y
        radius2 = (x * x + y * y).astype(np.float32)
        share = self._options.vignetting / float(radius2.max())
        return np.asarray(self._options.gain * (1.0 - share * radius2), dtype=np.float32)

    def _nearest(self, samples: _Samples, world_from_cam: Pose) -> tuple[Floats, NDArray[np.int16]]:
        """Return, for every sample, one over its depth (0 for sky) and the surface it sees."""
        cam_from_world = world_from_cam.inverse()
        corners = cam_from_world.apply(self._corners)
        towards = world_from_cam.translation - self._corners[:, 0]
        faces_us = np.einsum("mi,mi->m", self._outward, towards) > 1e-9
        chosen = np.flatnonzero(faces_us & (corners[:, :, 2].max(axis=1) > _NEAR_M))
        chosen = chosen[np.argsort(corners[chosen, :, 2].mean(axis=1), kind="stable")]
        inverse_depth = np.zeros(samples.shape, dtype=np.float32)
        nearest = np.full(samples.shape, SKY, dtype=np.int16)
        kernels.find_nearest(
            chosen,
            self._forms(chosen, cam_from_world),
            kernels.boxes_of(corners[chosen], _NEAR_M, samples.of_columns, samples.of_rows),
            self._sizes,
            self._first_hole,
            self._holes,
            samples.x,
            samples.y,
            inverse_depth,
            nearest,
        )
        return inverse_depth, nearest

    def _forms(self, chosen: NDArray[np.int64], cam_from_world: Pose) -> Floats:
        """Return (C, 3, 3) that take (x, y, 1) to (u, v, 1) / depth, u and v in metres."""
        planes = np.empty((len(chosen), 3, 3))
        planes[:, :, :2] = cam_from_world.rotation @ self._axes[chosen]
        planes[:, :, 2] = cam_from_world.apply(self._corners[chosen, 0])
        return np.linalg.inv(planes).astype(np.float32)

    def _shade(self, nearest: NDArray[np.int16], world_from_cam: Pose) -> Floats:
        """Return the (H S, W S) light of every sample, in grey levels."""
        flat = nearest.ravel()
        light = np.empty(flat.shape, dtype=np.float32)
        order = np.argsort(flat, kind="stable")  # a radix sort: gathers each surface's samples
        counts = np.bincount(flat + 1, minlength=len(self._world.surfaces) + 1)
        ends = np.cumsum(counts)
        x, y, spacing = self._fine.x.ravel(), self._fine.y.ravel(), self._fine.spacing
        seen = np.flatnonzero(counts[1:])
        forms = self._forms(seen, world_from_cam.inverse())
        if counts[0]:
            members = order[: counts[0]]
            _shade_sky(self._world.sky, world_from_cam, members, x[members], y[members], light)
        for index, form in zip(seen, forms, strict=True):
            members = order[ends[index] : ends[index + 1]]
            surface = self._world.surfaces[index]
            size, texture = (surface.width_m, surface.height_m), surface.texture
            kernels.shade(
                members, x, y, form, size, spacing, texture.texels, texture.shelves, light
            )
        return light.reshape(nearest.shape)


def _corners_m(width_m: float, height_m: float) -> list[tuple[float, float]]:
    return [(0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m)]


def _shade_sky(
    sky: Texture,
    world_from_cam: Pose,
    members: NDArray[np.int64],
    x: Floats,
    y: Floats,
    light: Floats,
) -> None:
    """Enter the light of the sky in the (N,) directions (x, y, 1) of the camera."""
    r = world_from_cam.rotation.astype(np.float32)
    north, east, down = (r[i, 0] * x + (r[i, 1] * y + r[i, 2]) for i in range(3))
    length = np.sqrt(north * north + east * east + down * down)
    lift = 1.0 / (np.float32(0.2) * length + np.maximum(-down, 0.0)) / (2 * _SKY_HALF_SPAN)
    across, along = np.float32(0.5) + north * lift, np.float32(0.5) + east * lift
    kernels.look_up(members, across, along, sky.texels, sky.shelves, light)
