"""New views adjusted together with what lies around them, the rest of the map held (IV-G)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.culling import Mask
from vcl_companion.mapping.weighing import adjust_weighed
from vcl_companion.vision.bundle import BundleOptions, Views

# Old keyframes that an extension may still move: so many; of a map of more no more than half of
# those that share so many landmarks with the new views. The other half holds the scale, which
# would go a little wrong each time with nothing but far keyframes to hold it.
_NEAREST, _SHARED = 9, 40


def adjusted_near(
    views: Views, noise: Array, good: Mask, n_keys: int, options: BundleOptions
) -> Views:
    """Adjust the new views, the old keyframes that share most with them, and what these see.

    The others are held where they are: what they could still learn is little, frame and scale
    are theirs, and the cost of an extension does not grow with the map.

    Args:
        views: of which the first ``n_keys`` are old.
        noise: (N, 3) of each landmark (``Table.noise``).
        good: (N,) landmarks to be used.
        n_keys: see above.
        options: of the adjustment.

    Returns:
        All views with what was adjusted.
    """
    seen = np.asarray(np.isfinite(views.ideal[:, :, 0]) & good[:, None])
    shown = np.any(seen[:, n_keys:], axis=1)
    shared = seen[shown, :n_keys].sum(axis=0)
    moving = np.zeros(len(views.bodies), dtype=bool)
    moving[n_keys:] = True
    n_moving = _NEAREST
    if n_keys > _NEAREST:
        n_moving = min(_NEAREST, int((shared >= _SHARED).sum()) // 2)
    moving[np.argsort(-shared, kind="stable")[:n_moving]] = True
    moving[0] = False
    order = np.argsort(moving, kind="stable")
    place = np.argsort(order)
    rows = np.flatnonzero((seen & moving).any(axis=1))
    part = Views(
        bodies=tuple(views.bodies[i] for i in order),
        mountings=tuple(views.mountings[i] for i in order),
        slopes=views.slopes[rows][:, order],
        ideal=views.ideal[rows][:, order],
        points=views.points[rows],
        distances=tuple(replace(d, a=int(place[d.a]), b=int(place[d.b])) for d in views.distances),
        n_held=int(np.sum(~moving)),
    )
    adjusted, _ = adjust_weighed(part, noise[rows], options)
    points = views.points.copy()
    points[rows] = adjusted.points
    bodies = tuple(adjusted.bodies[place[i]] for i in range(len(order)))
    return replace(views, bodies=bodies, points=points)
