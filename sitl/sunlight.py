"""Sun and cast shadows, baked into the textures once.

The sun is so far away that a rectangle's shadow on another one's plane is a
parallelogram: shadows are drawn as polygons, not traced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sitl.faces import Face
from sitl.textures import Canvas
from sitl.world import Surface, Texture
from vcl_companion.geometry.rotation import Array

_SHADOW_TEXELS_PER_M = 16.0
_MAX_SHADOW_TEXELS = 2048
_CLEARANCE_M = 0.01  # what lies in or touches a plane casts no shadow on it
_GRAZING = 0.02


@dataclass(frozen=True)
class Sun:
    """Where light comes from.

    Attributes:
        azimuth_deg: heading towards the sun, from north to east.
        elevation_deg: above the horizon.
        strength: light of the sun on a surface square to it, over that of an open sky.
    """

    azimuth_deg: float = 200.0
    elevation_deg: float = 42.0
    strength: float = 0.7

    def __post_init__(self) -> None:
        if not 1.0 <= self.elevation_deg <= 90.0 or self.strength < 0.0:
            raise ValueError("sun: elevation_deg is 1 to 90, strength not negative")

    @property
    def towards(self) -> Array:
        """The (3,) unit vector towards the sun, NED."""
        azimuth, elevation = np.deg2rad([self.azimuth_deg, self.elevation_deg])
        flat = np.cos(elevation)
        return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), -np.sin(elevation)])


def lit(faces: Sequence[Face], sun: Sun) -> tuple[Surface, ...]:
    """Shine on painted faces and make surfaces of them, in the same order."""
    corners = np.array(
        [
            [face.frame.point(u, v) for u in (0.0, face.width_m) for v in (0.0, face.height_m)]
            for face in faces
        ]
    )
    towards = sun.towards
    # Two axes square to the sun: only what overlaps there can shade each other.
    across = np.linalg.svd(towards[None, :])[2][1:]
    flat = corners @ across.T
    low, high = flat.min(axis=1), flat.max(axis=1)
    height = corners @ towards
    surfaces = []
    for i, face in enumerate(faces):
        outward = -face.frame.inward
        incidence = float(outward @ towards)
        canvas = face.canvas * np.float32(_ambient(outward))
        if incidence > _GRAZING and sun.strength > 0.0:
            overlaps = np.all((low <= high[i]) & (high >= low[i]), axis=1)
            overlaps &= height.max(axis=1) > height[i].min()
            overlaps[i] = False
            blockers = [faces[j] for j in np.flatnonzero(overlaps).tolist() if faces[j].casts]
            shadow = _shadow(face, blockers, towards)
            light = 1.0 + sun.strength * incidence * (1.0 - shadow)
            canvas = canvas * np.asarray(light, dtype=np.float32)
        image = np.clip(np.rint(canvas), 0, 255).astype(np.uint8)
        surfaces.append(
            Surface(
                face.frame.origin,
                face.frame.right,
                face.frame.down,
                face.width_m,
                face.height_m,
                Texture.from_image(image),
                face.holes,
                face.name,
            )
        )
    return tuple(surfaces)


def _ambient(outward: Array) -> float:
    """Return how much of the sky (and of what the ground throws back) a face sees."""
    return float(0.85 - 0.2 * outward[2])


def _shadow(face: Face, blockers: Sequence[Face], towards: Array) -> Canvas:
    """Return how much of the sun is hidden, 0 to 1, shaped like the face's canvas."""
    size = np.array([face.width_m, face.height_m])
    shape = np.clip(np.ceil(size * _SHADOW_TEXELS_PER_M), 2, _MAX_SHADOW_TEXELS).astype(int)
    scale = shape / size
    mask = np.zeros((shape[1], shape[0]), dtype=np.uint8)
    axes = np.stack([face.frame.right, face.frame.down], axis=1)
    for blocker, cast in _cast_all(blockers, face, towards):
        outline = cast
        if outline is None:
            outline = _cast(blocker, (0.0, 0.0, blocker.width_m, blocker.height_m), face, towards)
        if outline is None:
            continue
        layer = np.zeros_like(mask) if len(blocker.holes) else mask
        cv2.fillConvexPoly(layer, _texels(outline @ axes, scale), (255,))
        for left, top, right, bottom in blocker.holes.tolist():
            opening = _cast(blocker, (left, top, right, bottom), face, towards)
            if opening is not None:
                cv2.fillConvexPoly(layer, _texels(opening @ axes, scale), (0,))
        if layer is not mask:
            np.maximum(mask, layer, out=mask)
    if not mask.any():
        return np.zeros((1, 1), dtype=np.float32)
    soft = cv2.GaussianBlur(mask, (0, 0), 0.8)
    grown = cv2.resize(soft, face.canvas.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(grown, dtype=np.float32) / np.float32(255.0)


def _texels(points_m: Array, scale: Array) -> np.ndarray[tuple[int, int], np.dtype[np.int32]]:
    texels = np.clip(points_m * scale - 0.5, -1e6, 1e6)
    return np.asarray(np.rint(texels), dtype=np.int32).reshape(-1, 2)


def _cast_all(
    blockers: Sequence[Face], face: Face, towards: Array
) -> list[tuple[Face, Array | None]]:
    """Throw all blockers onto a face's plane at once.

    Returns:
        Those that do not lie behind the plane, each with its (4, 3) outline as
        ``_cast`` gives it, or with None where the plane cuts it.
    """
    if not blockers:
        return []
    right = np.array([b.width_m * b.frame.right for b in blockers])
    down = np.array([b.height_m * b.frame.down for b in blockers])
    corner = np.array([b.frame.origin for b in blockers]) - face.frame.origin
    points = np.stack([corner, corner + right, corner + right + down, corner + down], axis=1)
    outward = -face.frame.inward
    height = points @ outward - _CLEARANCE_M
    outlines = points - (points @ outward / (towards @ outward))[..., None] * towards
    whole = height.min(axis=1) > 0.0
    return [
        (blockers[i], outlines[i] if whole[i] else None)
        for i in np.flatnonzero(height.max(axis=1) > 0.0).tolist()
    ]


def _cast(
    blocker: Face, rect: tuple[float, float, float, float], face: Face, towards: Array
) -> Array | None:
    """Throw a rectangle of a blocker along the sun onto a face's plane.

    Returns:
        (K, 3) outline relative to the face's corner, m; None where all of it
        lies behind the plane.
    """
    left, top, right, bottom = rect
    u = np.array([left, right, right, left])[:, None]
    v = np.array([top, top, bottom, bottom])[:, None]
    corner = blocker.frame.origin - face.frame.origin
    points = corner + u * blocker.frame.right + v * blocker.frame.down
    outward = -face.frame.inward
    above = points @ outward - _CLEARANCE_M
    if above.max() <= 0.0:
        return None
    kept = []
    for i in range(4):
        j = (i + 1) % 4
        if above[i] > 0.0:
            kept.append(points[i])
        if (above[i] > 0.0) != (above[j] > 0.0):
            share = above[i] / (above[i] - above[j])
            kept.append(points[i] + share * (points[j] - points[i]))
    outline = np.array(kept)
    return np.asarray(outline - (outline @ outward / (towards @ outward))[:, None] * towards)
