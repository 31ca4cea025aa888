"""Patches of keyframes found again in a frame (IV-D)."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import patch_kernels as kernels
from vcl_companion.vision import patch_views
from vcl_companion.vision.patch_tables import Anchors, Ints, Lens, Pyramid


@dataclass(frozen=True)
class AlignRules:
    """How patches are aligned, and what is thought of the result.

    Attributes:
        max_iterations: of one patch.
        least_score: zero-mean normalised correlation of an aligned patch, at least.
        max_moved_px: farther from where it began an alignment is not believed, level px.
        settled_px: a step below this is the last.
        misplaced_px: what an alignment is off whatever the view, 1 sigma.
        misplaced_px_per_rad: per angle between the lines of sight.
        misplaced_px_per_octave: per doubling or halving of the distance.
        misplaced_by_residual: per sigma that the residual of the grey levels explains.
        forgives_noise: whether the correlation is of what both images would show without noise.
            So a frame in the dark is found by the map; what makes a map has to be like itself.
    """

    max_iterations: int = 10
    least_score: float = 0.75
    max_moved_px: float = 3.0
    settled_px: float = 0.05
    misplaced_px: float = 0.04
    misplaced_px_per_rad: float = 0.5
    misplaced_px_per_octave: float = 0.03
    misplaced_by_residual: float = 0.7
    forgives_noise: bool = False


@dataclass(frozen=True, eq=False)
class Alignment:
    """Patches looked for in one frame; what was not found is NaN or zero.

    Attributes:
        anchors: (M,) which.
        points_world: (M, 3) where they are in the map, m, and
        spread: (M, 6) how exactly it knows (``Anchors.spread``).
        predicted: (M, 2) raw px.
        pixels: (M, 2) where they were found, raw px.
        ideal: (M, 2) the same as ideal image coordinates.
        slopes: (M, 2, 2) d(pixel) / d(ideal) there.
        noise: (M, 3) xx xy yy of ``pixels`` by the residual of the grey levels, px^2.
        misplaced: (M, 3) of what is the same in every frame taken from here, px^2.
        scores: (M,) correlation.
        status: (M,) FOUND or why not.
    """

    anchors: Ints
    points_world: Array
    spread: Array
    predicted: Array
    pixels: Array
    ideal: Array
    slopes: Array
    noise: Array
    misplaced: Array
    scores: Array
    status: Ints

    @property
    def found(self) -> NDArray[np.bool_]:
        """(M,) which were found."""
        return np.asarray(self.status == kernels.FOUND)

    def of(self, kept: NDArray[np.bool_]) -> Alignment:
        """Return some of them."""
        rows = np.flatnonzero(kept)
        return Alignment(*(getattr(self, one.name).take(rows, axis=0) for one in fields(self)))


def align_patches(
    anchors: Anchors,
    chosen: Ints,
    frame: Pyramid,
    lens: Lens,
    cam_from_world: Pose,
    radii_px: Array,
    level: int,
    rules: AlignRules,
) -> Alignment:
    """Find the patches of chosen anchors in a frame.

    Args:
        anchors: of the map.
        chosen: (M,) which.
        frame: the image.
        lens: of its camera.
        cam_from_world: predicted pose.
        radii_px: (M,) how far to search before aligning; below one pixel of the level not at all.
        level: of the pyramid, 0 the full resolution; capped by what there is.
        rules: when an alignment is believed.
    """
    images = anchors.images
    views, seen = patch_views.viewed(
        chosen,
        anchors.keyframe,
        anchors.planes,
        lens.table,
        lens.reach,
        images.transforms(cam_from_world),
    )
    pixels, noise, misplaced, scores, status = kernels.align(
        views,
        seen,
        anchors.keyframe.take(chosen),
        anchors.pixels.take(chosen, axis=0),
        images.texels,
        images.shelves,
        images.noises,
        frame.texels,
        frame.shelves,
        frame.noise,
        radii_px,
        np.array(
            [
                rules.max_iterations,
                rules.least_score,
                rules.max_moved_px,
                rules.settled_px,
                rules.misplaced_px,
                rules.misplaced_px_per_rad,
                rules.misplaced_px_per_octave,
                rules.misplaced_by_residual,
                rules.forgives_noise,
            ],
            dtype=np.float64,
        ),
        min(level, len(frame.shelves) - 1),
    )
    ideal, slopes = patch_views.unbent(lens.table, pixels, views)
    predicted = np.where(seen[:, None], views[:, 3:5], np.nan)
    return Alignment(
        chosen,
        anchors.points_world.take(chosen, axis=0),
        anchors.spread.take(chosen, axis=0),
        predicted,
        pixels,
        ideal,
        slopes,
        noise,
        misplaced,
        scores,
        status,
    )
