"""The joint normal matrix of views and landmarks, and what is left of it without the landmarks.

Compiled. Observations stand landmark by landmark, by rising view, as in ``bundle_kernels``; what is
made of a landmark is as large as the views that see it are many, but for its lever.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle_kernels import Ints, linearized


@compiled
def seen_aside(points: Array, centres: Array, first: Ints, view: Ints) -> tuple[Array, Array]:
    """Return how differently each observation sees its landmark than all of them on average do.

    Args:
        points: (N, 3).
        centres: (V, 3) where the cameras were.
        first: (N + 1,).
        view: (M,).

    Returns:
        (M,) angle between the line of sight and the mean of the landmark's, rad; (M, 3) how far the
        camera is from the mean of those that see the landmark, by their mean distance from it.
    """
    angles, moved = np.empty(len(view)), np.empty((len(view), 3))
    for j in range(len(points)):
        mean, middle, distance = np.zeros(3), np.zeros(3), 0.0
        n = first[j + 1] - first[j]
        for m in range(first[j], first[j + 1]):
            sight = points[j] - centres[view[m]]
            away = np.sqrt(sight @ sight)
            mean += sight / away
            middle += centres[view[m]] / n
            distance += away / n
        mean /= np.sqrt(mean @ mean)
        for m in range(first[j], first[j + 1]):
            sight = points[j] - centres[view[m]]
            cosine = sight @ mean / np.sqrt(sight @ sight)
            angles[m] = np.arccos(min(max(cosine, -1.0), 1.0))
            moved[m] = (centres[view[m]] - middle) / distance
    return angles, moved


@compiled
def joined(
    points: Array,
    bodies: Array,
    mountings: Array,
    first: Ints,
    view: Ints,
    slopes: Array,
    ideal: Array,
    errors: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Linearise every observation, each weighing one.

    Args:
        points: (N, 3), and so on as ``bundle_kernels.reduced`` takes them.
        bodies: (V, 3, 4).
        mountings: (V, 3, 4).
        first: (N + 1,).
        view: (M,).
        slopes: (M, 2, 2) by which residuals are in units of their own sigma.
        ideal: (M, 2).
        errors: (M, 2, F) by how much observations would be off by each of F causes, likewise.

    Returns:
        (6V, 6V) normal matrix of the views, of blocks; (N, 3, 3) of the landmarks; (M, 3, 6)
        couplings; (6V, F) what the causes add to the right side of the views, (N, 3, F) of the
        landmarks.
    """
    size, n_causes = 6 * len(bodies), errors.shape[2]
    of_views, of_points = np.zeros((size, size)), np.zeros((len(points), 3, 3))
    crosses = np.zeros((len(view), 3, 6))
    view_pulls, point_pulls = np.zeros((size, n_causes)), np.zeros((len(points), 3, n_causes))
    residual, j_pose, j_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    for j in range(len(points)):
        for m in range(first[j], first[j + 1]):
            i = view[m]
            linearized(
                points[j], bodies[i], mountings[i], slopes[m], ideal[m], residual, j_pose, j_point
            )
            a = 6 * i
            for k in range(2):
                for r in range(6):
                    for c in range(6):
                        of_views[a + r, a + c] += j_pose[k, r] * j_pose[k, c]
                    for c in range(3):
                        crosses[m, c, r] += j_pose[k, r] * j_point[k, c]
                    for f in range(n_causes):
                        view_pulls[a + r, f] += j_pose[k, r] * errors[m, k, f]
                for r in range(3):
                    for c in range(3):
                        of_points[j, r, c] += j_point[k, r] * j_point[k, c]
                    for f in range(n_causes):
                        point_pulls[j, r, f] += j_point[k, r] * errors[m, k, f]
    return of_views, of_points, crosses, view_pulls, point_pulls


@compiled
def without_points(
    first: Ints,
    view: Ints,
    crosses: Array,
    inverses: Array,
    point_pulls: Array,
    of_views: Array,
    view_pulls: Array,
    levers: NDArray[np.float32],
) -> None:
    """Eliminate the landmarks from what ``joined`` has made.

    Args:
        first: (N + 1,).
        view: (M,).
        crosses: (M, 3, 6).
        inverses: (N, 3, 3) of the landmarks' normal matrices.
        point_pulls: (N, 3, F).
        of_views: (6V, 6V), reduced by this.
        view_pulls: (6V, F), likewise.
        levers: (N, 3, 6V) zero; filled with how landmarks move with the views.
    """
    left = np.empty((6, 3))
    for j in range(len(inverses)):
        inverse, pull = inverses[j], point_pulls[j]
        for m in range(first[j], first[j + 1]):
            a = 6 * view[m]
            for r in range(6):
                for c in range(3):
                    left[r, c] = (
                        crosses[m, 0, r] * inverse[0, c]
                        + crosses[m, 1, r] * inverse[1, c]
                        + crosses[m, 2, r] * inverse[2, c]
                    )
                    levers[j, c, a + r] = -left[r, c]
                for f in range(pull.shape[1]):
                    view_pulls[a + r, f] -= (
                        left[r, 0] * pull[0, f] + left[r, 1] * pull[1, f] + left[r, 2] * pull[2, f]
                    )
            for n in range(first[j], first[j + 1]):
                b, cross = 6 * view[n], crosses[n]
                for r in range(6):
                    row, x, y, z = of_views[a + r, b : b + 6], left[r, 0], left[r, 1], left[r, 2]
                    for c in range(6):
                        row[c] -= x * cross[0, c] + y * cross[1, c] + z * cross[2, c]
