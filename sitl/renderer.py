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

from sitl.sampling import sampled
from sitl.world import SKY, Grey, Surface, Texture, World
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array

Floats = NDArray[np.float32]

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
            x, y = ideal[:, 0].reshape(self.shape), ideal[:, 1].reshape(self.shape)
            self.x, self.y = x.astype(np.float32), y.astype(np.float32)
        else:  # broadcasting one row against one column is several times cheaper
            self.x = ((columns - camera.cx_px) / camera.fx_px).astype(np.float32)[None, :]
            self.y = ((rows - camera.cy_px) / camera.fy_px).astype(np.float32)[:, None]
        self.flat_x = np.ascontiguousarray(np.broadcast_to(self.x, self.shape)).ravel()
        self.flat_y = np.ascontiguousarray(np.broadcast_to(self.y, self.shape)).ravel()
        self.column_range = self.x.min(axis=0), self.x.max(axis=0)
        self.row_range = self.y.min(axis=1), self.y.max(axis=1)
        # One sample's area on the ideal plane, taken at the principal point.
        self.spacing = 1.0 / (camera.focal_px * per_pixel)

    def box(self, corners_cam: Array) -> tuple[slice, slice] | None:
        """Return rows and columns that may see a polygon, (K, 3) corners; None if none can."""
        polygon = _in_front(corners_cam)
        if len(polygon) == 0:
            return None
        ideal = polygon[:, :2] / polygon[:, 2:]
        (left, top), (right, bottom) = ideal.min(axis=0), ideal.max(axis=0)
        columns = np.flatnonzero((self.column_range[0] <= right) & (self.column_range[1] >= left))
        rows = np.flatnonzero((self.row_range[0] <= bottom) & (self.row_range[1] >= top))
        if len(columns) == 0 or len(rows) == 0:
            return None
        return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _in_front(corners_cam: Array) -> Array:
    """Return the part of a convex polygon, (K, 3), that lies beyond the near plane."""
    z = corners_cam[:, 2]
    if z.min() >= _NEAR_M:
        return corners_cam
    kept = []
    for i in range(len(corners_cam)):
        j = (i + 1) % len(corners_cam)
        if z[i] >= _NEAR_M:
            kept.append(corners_cam[i])
        if (z[i] >= _NEAR_M) != (z[j] >= _NEAR_M):
            share = (_NEAR_M - z[i]) / (z[j] - z[i])
            kept.append(corners_cam[i] + share * (corners_cam[j] - corners_cam[i]))
    return np.array(kept).reshape(-1, 3)


def _linear_forms(surface: Surface, cam_from_world: Pose) -> Array:
    """Return the (3, 3) matrix that takes (x, y, 1) to (u, v, 1) / depth, u and v in metres."""
    corner = cam_from_world.apply(surface.corner)
    axes = np.stack([surface.right, surface.down], axis=1)
    plane = np.column_stack([cam_from_world.rotation @ axes, corner])
    return np.asarray(np.linalg.inv(plane), dtype=np.float64)


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
        inverse_depth = np.zeros(samples.shape, dtype=np.float32)
        nearest = np.full(samples.shape, SKY, dtype=np.int16)
        cam_from_world = world_from_cam.inverse()
        corners_cam = cam_from_world.apply(self._corners)
        faces_us = (
            np.einsum("mi,mi->m", self._outward, world_from_cam.translation - self._corners[:, 0])
            > 1e-9
        )
        # Near ones first, so that most samples of what stands behind fail the first test.
        order = np.argsort(corners_cam[:, :, 2].mean(axis=1))
        for index in order[faces_us[order] & (corners_cam[order, :, 2].max(axis=1) > _NEAR_M)]:
            box = samples.box(corners_cam[index])
            if box is None:
                continue
            surface = self._world.surfaces[index]
            forms = _linear_forms(surface, cam_from_world).astype(np.float32)
            x, y = _part(samples, box)
            q = forms[2, 0] * x + (forms[2, 1] * y + forms[2, 2])
            seen = q > inverse_depth[box]
            u = forms[0, 0] * x + (forms[0, 1] * y + forms[0, 2])
            v = forms[1, 0] * x + (forms[1, 1] * y + forms[1, 2])
            seen &= u >= 0.0
            seen &= v >= 0.0
            seen &= u <= np.float32(surface.width_m) * q
            seen &= v <= np.float32(surface.height_m) * q
            if len(surface.holes):
                self._pierce(seen, samples, box, surface, cam_from_world, (u, v, q))
            np.copyto(inverse_depth[box], q, where=seen)
            np.copyto(nearest[box], np.int16(index), where=seen)
        return inverse_depth, nearest

    @staticmethod
    def _pierce(
        seen: NDArray[np.bool_],
        samples: _Samples,
        box: tuple[slice, slice],
        surface: Surface,
        cam_from_world: Pose,
        forms: tuple[Floats, Floats, Floats],
    ) -> None:
        """Clear in ``seen`` the samples of ``box`` that look through a hole of the surface."""
        for left, top, right, bottom in surface.holes.tolist():
            opening = [(left, top), (right, top), (right, bottom), (left, bottom)]
            corners = cam_from_world.apply(np.array([surface.point(u, v) for u, v in opening]))
            hole = samples.box(corners)
            if hole is None:
                continue
            part = tuple(
                slice(max(h.start, b.start) - b.start, max(0, min(h.stop, b.stop) - b.start))
                for h, b in zip(hole, box, strict=True)
            )
            u, v, q = (form[part] for form in forms)
            inside = (u > np.float32(left) * q) & (u < np.float32(right) * q)
            inside &= (v > np.float32(top) * q) & (v < np.float32(bottom) * q)
            seen[part] &= ~inside

    def _shade(self, nearest: NDArray[np.int16], world_from_cam: Pose) -> Floats:
        """Return the (H S, W S) light of every sample, in grey levels."""
        flat = nearest.ravel()
        light = np.empty(flat.shape, dtype=np.float32)
        order = np.argsort(flat, kind="stable")  # a radix sort: gathers each surface's samples
        counts = np.bincount(flat + 1, minlength=len(self._world.surfaces) + 1)
        ends = np.cumsum(counts)
        cam_from_world = world_from_cam.inverse()
        samples = self._fine
        for group in np.flatnonzero(counts):
            members = order[ends[group] - counts[group] : ends[group]]
            x, y = samples.flat_x[members], samples.flat_y[members]
            index = int(group) - 1
            if index == SKY:
                light[members] = _sky_light(self._world.sky, world_from_cam, x, y)
                continue
            surface = self._world.surfaces[index]
            forms = _linear_forms(surface, cam_from_world)
            light[members] = _surface_light(surface, forms, x, y, samples.spacing)
        return light.reshape(nearest.shape)


def _corners_m(width_m: float, height_m: float) -> list[tuple[float, float]]:
    return [(0.0, 0.0), (width_m, 0.0), (width_m, height_m), (0.0, height_m)]


def _part(samples: _Samples, box: tuple[slice, slice]) -> tuple[Floats, Floats]:
    """Return the samples' ideal coordinates in a box, ready to broadcast."""
    rows, columns = box
    if samples.x.shape[0] == 1 and samples.y.shape[1] == 1:
        return samples.x[:, columns], samples.y[rows]
    return samples.x[box], samples.y[box]


def _surface_light(surface: Surface, forms: Array, x: Floats, y: Floats, spacing: float) -> Floats:
    """Return the (N,) light of samples (x, y) on a surface, filtered to the sample's footprint."""
    a, b, c = forms.astype(np.float32).T
    depth = 1.0 / (a[2] * x + (b[2] * y + c[2]))
    u = (a[0] * x + (b[0] * y + c[0])) * depth
    v = (a[1] * x + (b[1] * y + c[1])) * depth
    height, width = surface.texture.levels[0].shape
    # The footprint: between its geometric mean and its root mean square, which
    # on grazing surfaces trades a little aliasing against losing all texture.
    area = np.float32(abs(np.linalg.det(forms))) * depth * depth * depth
    squares = np.square(a[0] - u * a[2]) + np.square(b[0] - u * b[2])
    squares += np.square(a[1] - v * a[2]) + np.square(b[1] - v * b[2])
    squares *= np.float32(0.5) * depth * depth
    texels = spacing * np.sqrt(width * height / (surface.width_m * surface.height_m))
    level = np.float32(0.25) * np.log2(area * squares) + np.float32(np.log2(texels))
    return sampled(
        surface.texture, u / np.float32(surface.width_m), v / np.float32(surface.height_m), level
    )


def _sky_light(sky: Texture, world_from_cam: Pose, x: Floats, y: Floats) -> Floats:
    """Return the (N,) light of the sky in the directions (x, y, 1) of the camera."""
    r = world_from_cam.rotation.astype(np.float32)
    north, east, down = (r[i, 0] * x + (r[i, 1] * y + r[i, 2]) for i in range(3))
    length = np.sqrt(north * north + east * east + down * down)
    lift = 1.0 / (np.float32(0.2) * length + np.maximum(-down, 0.0)) / (2 * _SKY_HALF_SPAN)
    return sampled(sky, 0.5 + north * lift, 0.5 + east * lift, np.zeros_like(x))
