"""Landmarks cut out as patches where one view sees them, and found in all other views.

What a detector reports is a quarter of a pixel off, and alike in neighbouring
features, so that bundle adjustment cannot average it out. A patch aligned with
another view says to some hundredths of a pixel where the same spot of the
surface is there; the view that it is cut from has no error by definition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.surfaces import slopes_of
from vcl_companion.vision.patch_tables import (
    Anchors,
    KeyframeImages,
    Pyramid,
    laid_out,
    lens_of,
    pyramid_of,
)
from vcl_companion.vision.patches import AlignRules, align_patches

# Patches near where they are known to be: by who extends a map, and who tells what it sees of it.
EXACTLY = AlignRules(max_iterations=15, least_score=0.85, max_moved_px=1.5, settled_px=0.02)

PyramidOf = Callable[[bytes, Camera], Pyramid]

_MARGIN_PX = 7.0
_LEAST_COSINE = np.cos(np.deg2rad(60.0))
# Not magnified more than, nor shrunk more than.
_MAX_NEARER, _MAX_FARTHER = 2.8, 5.0


def decoded_pyramid(image_bytes: bytes, camera: Camera) -> Pyramid:
    """Return the pyramid of an encoded image.

    Raises:
        ValueError: it is no image, or not one of this camera.
    """
    return pyramid_of(decode_image(image_bytes, camera))


def pyramids_of(
    images: Sequence[tuple[bytes, Camera]], pyramid_of: PyramidOf
) -> list[Pyramid | None]:
    """Return the pyramids of encoded images; None where the bytes are no image of that camera."""
    out: list[Pyramid | None] = []
    for image_bytes, camera in images:
        try:
            out.append(pyramid_of(image_bytes, camera))
        except ValueError:
            out.append(None)
    return out


@dataclass(frozen=True, eq=False)
class Reference:
    """Landmarks, each in the view that its patch is cut from.

    Attributes:
        view: (M,) which.
        pixels: (M, 2) where it is there, raw px.
        points: (M, 3) world, m.
        sigma: (M,) relative error of its distance, roughly.
    """

    view: Index
    pixels: Array
    points: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Found:
    """Landmarks looked for in V views; NaN where they were not found.

    Attributes:
        pixels: (M, V, 2) raw px; in the view that the patch is cut from, where it is cut.
        noise: (M, V, 3) xx xy yy of what the grey levels leave unexplained, px^2; NaN in that view.
    """

    pixels: Array
    noise: Array


def landmark_noise(noise: Array) -> Array:
    """Return (M, 3) of (M, V, 3) what the views find that is neither best nor worst; NaN for none.

    Of an even number of views the better one of the two in the middle.
    """
    size = noise[:, :, 0] + noise[:, :, 2]
    rising = np.argsort(size, axis=1)  # what was not found comes last
    middle = np.maximum(np.isfinite(size).sum(axis=1) - 1, 0) // 2
    rows = np.arange(len(noise))
    return np.asarray(noise[rows, rising[rows, middle]])


class PatchTable:
    """The images of some views, and where these were taken.

    Args:
        cameras: of V views.
        pyramids: their images; None where there is no usable one.
    """

    def __init__(self, cameras: list[Camera], pyramids: list[Pyramid | None]) -> None:
        self._cameras = cameras
        self._lenses = [lens_of(camera) for camera in cameras]
        self._pyramids = pyramids
        usable = [p for p in pyramids if p is not None]
        n_levels = min((len(p.shelves) for p in usable), default=1)
        empty = Pyramid(np.zeros(1, np.uint8), np.array([[0, 1, 1]] * n_levels, np.int64), 0.0)
        self._laid_out = laid_out([p or empty for p in pyramids])

    @property
    def n_views(self) -> int:
        """How many views there are."""
        return len(self._cameras)

    def found(
        self,
        reference: Reference,
        worlds_from_cams: list[Pose],
        targets: list[int],
        rules: AlignRules,
        reach_px: float = 0.0,
        level: int = 0,
    ) -> Found:
        """Return where patches are found, the reference included.

        Args:
            reference: the patches.
            worlds_from_cams: where the V views were taken.
            targets: views to look in.
            rules: when an alignment is believed.
            reach_px: how far around the prediction patches are searched first.
            level: of the pyramid that is searched; what is found is no finer than it.
        """
        out = np.full((len(reference.view), len(self._cameras), 2), np.nan)
        out[np.arange(len(reference.view)), reference.view] = reference.pixels
        noise = np.full((*out.shape[:2], 3), np.nan)
        anchors, fit = self._anchors(reference, worlds_from_cams)
        for i in targets:
            frame = self._pyramids[i]
            if frame is None:
                continue
            rows = np.flatnonzero(fit & (reference.view != i))
            rows = rows[self._comparable(reference, rows, worlds_from_cams, i)].astype(np.int64)
            if len(rows) == 0:
                continue
            cam_from_world = worlds_from_cams[i].inverse()
            radii = np.full(len(rows), reach_px)
            aligned = align_patches(
                anchors, rows, frame, self._lenses[i], cam_from_world, radii, level, rules
            )
            out[rows[aligned.found], i] = aligned.pixels[aligned.found]
            noise[rows[aligned.found], i] = aligned.noise[aligned.found]
        return Found(out, noise)

    def _comparable(
        self, reference: Reference, rows: Index, worlds_from_cams: list[Pose], i: int
    ) -> Array:
        """Return (K,) whether a view sees points from about where, and as large as, their own."""
        centres = np.stack([p.translation for p in worlds_from_cams])
        focal = np.array([c.focal_px for c in self._cameras])
        points = reference.points[rows]
        then, now = points - centres[reference.view[rows]], points - centres[i]
        a = np.maximum(np.linalg.norm(then, axis=1), 1e-9)
        b = np.maximum(np.linalg.norm(now, axis=1), 1e-9)
        cosine = np.einsum("ni,ni->n", then, now) / (a * b)
        larger = (a / b) * (focal[i] / focal[reference.view[rows]])
        alike = (cosine > _LEAST_COSINE) & (larger < _MAX_NEARER) & (larger > 1.0 / _MAX_FARTHER)
        return np.asarray(alike)

    def _anchors(self, reference: Reference, worlds_from_cams: list[Pose]) -> tuple[Anchors, Array]:
        """Return anchors for alignment, and (M,) whether each has a patch at all."""
        n = len(reference.view)
        planes, fit = np.zeros((n, 9)), np.zeros(n, dtype=bool)
        for i in np.unique(reference.view):
            rows = np.flatnonzero(reference.view == i)
            camera, pixels = self._cameras[i], reference.pixels[rows]
            z = worlds_from_cams[i].inverse().apply(reference.points[rows])[:, 2]
            ideal = camera.ideal_from_pixels(pixels)
            inside = camera.shows(pixels, _MARGIN_PX)
            ok = inside & (z > 0.05) & np.isfinite(ideal).all(axis=1) & np.isfinite(z)
            if self._pyramids[i] is None or not ok.any():
                continue
            rows, pixels, ideal, r = rows[ok], pixels[ok], ideal[ok], 1.0 / z[ok]
            sigma = np.maximum(reference.sigma[rows], 1e-4) * r
            slopes = slopes_of(pixels, ideal, r, sigma)
            inverse = np.linalg.inv(camera.pixel_slopes(ideal)).reshape(-1, 4)
            planes[rows] = np.column_stack([ideal, r, slopes, inverse])
            fit[rows] = True
        anchors = Anchors(
            first=np.arange(n + 1, dtype=np.int64),
            landmark=np.arange(n, dtype=np.int64),
            keyframe=np.asarray(reference.view, dtype=np.int64),
            planes=planes,
            pixels=np.ascontiguousarray(reference.pixels),
            points_world=reference.points,
            own=np.zeros((n, 3)),
            spread=np.zeros((n, 6)),
            texture=np.zeros((n, 3)),
            images=KeyframeImages(*self._laid_out, tuple(worlds_from_cams)),
        )
        return anchors, fit
