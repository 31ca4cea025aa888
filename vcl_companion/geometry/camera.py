"""A calibrated camera: where a point appears, and which ray a pixel looks along.

Pixel (0, 0) is the centre of the top-left pixel. Distortion models and their
coefficient order are OpenCV's and Kalibr's: ``radial-tangential`` (k1 k2 p1 p2
[k3]) and ``equidistant`` (k1 k2 k3 k4, Kannala-Brandt).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import writable
from vcl_companion.geometry import lens_kernels
from vcl_companion.geometry.rotation import Array

DistortionModel = Literal["none", "radial-tangential", "equidistant"]

_N_COEFFICIENTS = {"none": (0,), "radial-tangential": (4, 5), "equidistant": (4,)}
_MIN_DEPTH_M = 1e-6


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Attributes:
        width_px, height_px: image size.
        fx_px, fy_px: focal lengths.
        cx_px, cy_px: principal point, pixel centres at integers.
        distortion_model: see the module.
        distortion: its coefficients.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if not np.all(np.isfinite(numbers)):
            raise ValueError(f"camera: intrinsics must be finite, got {numbers}")
        if min(self.width_px, self.height_px) < 1 or min(self.fx_px, self.fy_px) <= 0:
            raise ValueError("camera: image size and focal lengths must be positive")
        expected = _N_COEFFICIENTS.get(self.distortion_model)
        if expected is None:
            known = ", ".join(_N_COEFFICIENTS)
            raise ValueError(
                f"camera: unknown distortion model {self.distortion_model!r} ({known})"
            )
        if len(self.distortion) not in expected:
            raise ValueError(
                f"camera: {self.distortion_model} takes {' or '.join(map(str, expected))} "
                f"coefficients, got {len(self.distortion)}"
            )

    @property
    def focal_px(self) -> float:
        """Mean focal length, px per unit of the ideal image plane."""
        return 0.5 * (self.fx_px + self.fy_px)

    def project(self, points_cam: Array) -> Array:
        """Return (N, 2) pixels of (N, 3) points in the camera frame, m.

        NaN behind the camera, and so far aside that the distortion polynomial,
        no longer a lens there, would fold the point back into the image.
        """
        z = points_cam[:, 2]
        front = z > _MIN_DEPTH_M
        ideal = points_cam[:, :2] / np.where(front, z, np.nan)[:, None]
        return self.pixels_from_ideal(ideal)

    def pixels_from_ideal(self, ideal: Array) -> Array:
        """Return (N, 2) pixels of (N, 2) ideal image coordinates x/z, y/z; NaN past the fold."""
        beyond = (ideal**2).sum(axis=1) >= self._fold_r2
        if beyond.any():
            ideal = np.where(beyond[:, None], np.nan, ideal)
        return self._distorted(ideal) * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)

    def shows(self, pixels: Array, margin_px: float) -> NDArray[np.bool_]:
        """Return (N,) whether (N, 2) pixels lie within the image, NaN nowhere.

        Args:
            pixels: the centres of the first and the last lie at 0 and at the size less 1.
            margin_px: by how much more than on these; -0.5 is all of the image.
        """
        size = np.array([self.width_px, self.height_px])
        with np.errstate(invalid="ignore"):
            inside = (pixels > margin_px) & (pixels < size - 1 - margin_px)
        return np.asarray(inside.all(axis=1))

    def pixel_slopes(self, ideal: Array) -> Array:
        """Return (N, 2, 2) d(pixel) / d(ideal) at (N, 2) ideal image coordinates, px.

        What weighs a residual of ideal coordinates as the detector's noise does:
        towards the edge of a wide lens a pixel is many times as large there.
        """
        if self._is_undistorted:
            slopes = np.zeros((len(ideal), 2, 2))
            slopes[:, 0, 0], slopes[:, 1, 1] = self.fx_px, self.fy_px
            return slopes
        if self.distortion_model == "radial-tangential":
            slopes = lens_kernels.slopes(_numbers(ideal), self._lens) * [[self.fx_px], [self.fy_px]]
            slopes[(ideal**2).sum(axis=1) >= self._fold_r2] = np.nan
            return np.asarray(slopes)
        step = 1e-6
        columns = [
            (self.pixels_from_ideal(ideal + shift) - self.pixels_from_ideal(ideal - shift))
            / (2 * step)
            for shift in (np.array([step, 0.0]), np.array([0.0, step]))
        ]
        return np.stack(columns, axis=2)

    def ideal_from_pixels(self, pixels: Array) -> Array:
        """Return (N, 2) ideal image coordinates x/z, y/z of (N, 2) pixels (distortion removed).

        Newton's method on the distortion; a row is NaN where it finds nothing
        (a pixel the model cannot have produced).
        """
        shown = (_numbers(pixels) - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)
        if self._is_undistorted:
            return np.asarray(shown)
        return lens_kernels.undistorted(shown, self._lens, self._is_fisheye, self._fold_r2)

    @cached_property
    def _is_undistorted(self) -> bool:
        """Whether the lens is a pinhole: of the equidistant model none is."""
        return not self._is_fisheye and not any(self.distortion)

    @cached_property
    def _fold_r2(self) -> float:
        """Squared ideal radius where the distorted radius stops growing; infinite if it never does.

        Beyond it the polynomial bends back: points far outside the view would
        be projected into the image.
        """
        if not any(self.distortion):
            return np.inf
        fisheye = self._is_fisheye
        radial = self.distortion if fisheye else self.distortion[:2] + self.distortion[4:]
        slope = np.array([1.0, *((2 * n + 3) * k for n, k in enumerate(radial))])
        # The root finder is no match for numbers that are no lens; a peer may send some.
        slope = np.clip(np.where(np.abs(slope) < 1e-12, 0.0, slope), -1e12, 1e12)
        roots = np.roots(slope[::-1])
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        square = float(real.min(initial=np.inf))
        if not fisheye:
            return square
        return float(np.tan(np.sqrt(square)) ** 2) if square < (np.pi / 2) ** 2 else np.inf

    def _distorted(self, ideal: Array) -> Array:
        """Return (N, 2) distorted normalised coordinates of (N, 2) ideal ones."""
        if self._is_undistorted:
            return ideal
        return lens_kernels.distorted(_numbers(ideal), self._lens, self._is_fisheye)

    @cached_property
    def _lens(self) -> Array:
        """The coefficients as ``lens_kernels`` takes them."""
        return np.array((*self.distortion, 0.0)[:5])

    @property
    def _is_fisheye(self) -> bool:
        return self.distortion_model == "equidistant"


def _numbers(values: Array) -> Array:
    """Return points of any kind of number as kernels take theirs."""
    return writable(np.asarray(values, dtype=np.float64))
