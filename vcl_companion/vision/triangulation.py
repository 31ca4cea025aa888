"""Points from rays of two or more cameras (IV-C), linear and then culled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled, writable
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array


def triangulate(worlds_from_cams: list[Pose], ideal: Array) -> Array:
    """Find the points nearest to their rays, over every view that saw them.

    Args:
        worlds_from_cams: V camera poses.
        ideal: (N, V, 2) ideal image coordinates x/z, y/z; NaN where unseen.

    Returns:
        (N, 3) points, world frame, m; NaN when seen by fewer than two views, when
        the rays are parallel, or when they all start from one place.
    """
    n = len(ideal)
    normal = np.zeros((n, 4, 4))
    # Around the cameras, or precision is lost with the square of the distance to the origin.
    centre = np.mean([pose.translation for pose in worlds_from_cams], axis=0)
    for i, world_from_cam in enumerate(worlds_from_cams):
        cam_from_world = Pose(
            world_from_cam.rotation, world_from_cam.translation - centre
        ).inverse()
        rows = np.hstack([cam_from_world.rotation, cam_from_world.translation[:, None]])
        seen = np.isfinite(ideal[:, i, 0])
        uv = np.where(seen[:, None], ideal[:, i], 0.0)
        # x (row 3 . X) - row 1 . X = 0, scaled by the ray's length so that views weigh alike
        equations = uv[:, :, None] * rows[2] - rows[:2]
        equations = equations / np.sqrt(1.0 + (uv**2).sum(axis=1))[:, None, None]
        equations = equations * seen[:, None, None]
        normal += np.einsum("nki,nkj->nij", equations, equations)
    n_seen = np.isfinite(ideal[:, :, 0]).sum(axis=1)
    values, vectors = np.linalg.eigh(normal)
    homogeneous = vectors[:, :, 0]
    w = homogeneous[:, 3]
    # The second eigenvalue is about the squared baseline, m^2: without one any depth will do.
    ok = (n_seen >= 2) & (np.abs(w) > 1e-9) & (values[:, 1] > 1e-12)
    points = homogeneous[:, :3] / np.where(ok, w, 1.0)[:, None] + centre
    points[~ok] = np.nan
    return np.asarray(points)


def ray_angles(worlds_from_cams: list[Pose], points: Array, seen: NDArray[np.bool_]) -> Array:
    """Return (N,) the widest angle under which each point is seen, rad; 0 with one view.

    Args:
        worlds_from_cams: V camera poses.
        points: (N, 3) landmarks, world frame, m.
        seen: (N, V) bool.
    """
    if len(worlds_from_cams) < 2:
        return np.zeros(len(points))
    origins = np.stack([world_from_cam.translation for world_from_cam in worlds_from_cams])
    return _widest_angles(origins, writable(points), writable(seen))


@compiled
def _widest_angles(origins: Array, points: Array, seen: NDArray[np.bool_]) -> Array:
    """Return ``ray_angles`` from (V, 3) camera centres."""
    out = np.zeros(len(points))
    rays = np.empty((len(origins), 3))
    for j in range(len(points)):
        n, least = 0, 1.0
        for i in range(len(origins)):
            if not seen[j, i]:
                continue
            x, y, z = (
                points[j, 0] - origins[i, 0],
                points[j, 1] - origins[i, 1],
                points[j, 2] - origins[i, 2],
            )
            size = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            rays[n, 0], rays[n, 1], rays[n, 2] = x / size, y / size, z / size
            for k in range(n):
                cosine = rays[n, 0] * rays[k, 0] + rays[n, 1] * rays[k, 1] + rays[n, 2] * rays[k, 2]
                least = min(least, cosine)
            n += 1
        out[j] = np.arccos(max(least, -1.0))
    return out
