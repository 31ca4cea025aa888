"""Patches that were found at the wrong place, by what most of their neighbours agree on (IV-B).

What repeats, as windows do, is taken for the next one, and then lies far behind or before what is
beside it. A few of those bend the poses until they fit them by some tenths of a pixel, for the
farthest landmarks are what a turn is known by. So a pair's pose is found again of those alone that
lie as deep as their neighbours, and whatever misses its epipolar lines is told. Before a flat wall
that pose is known so little that hardly one of them does; but together they miss it by more than
they could if they were right, and the fewer can be the less is believed of each. What is wrong
along the lines is not found, and bends nothing.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.apart import N_NEIGHBOURS, like_neighbours
from vcl_companion.mapping.tracks import ideal_of_pixels
from vcl_companion.vision.acransac import THRESHOLD_SIGMAS, Mask
from vcl_companion.vision.information import covariance_of, robust_sigma
from vcl_companion.vision.relative_pose import RelativePoseProblem, relative_pose_problem

# Noise of patches that agree, px, at most: the search of it starts there, or with what they miss
# the pose by that is there.
_NOISE_PX = 0.3
# What misses by more is wrong: sigmas, of no less than so many px.
_STRAY_SIGMAS, _LEAST_SIGMA_PX = 4.0, 0.075
# Landmarks that nothing beside them is as deep as are right, and miss by a sigma, or wrong, and
# miss by at least so many. How many are wrong is found of themselves: before that, one in five.
_WRONG_SIGMAS = 2.5
_AS_IF_WRONG, _AS_IF_RIGHT = 1.0, 4.0
_STEPS = 30
# One that is told is twice as likely to be wrong as to be right: right ones stand before a wall,
# where a pose is known best by them.
_LIKELIER = 2.0
# A pose that fewer of them bend shows more of them.
_ROUNDS = 4
# Those that a pose was found of fit it, most of them, or it says nothing of the others.
_FITTING = 0.5
_SINGULAR = 1e-10


def strays(
    points: Array,
    observed_px: Array,
    cut_from: NDArray[np.intp],
    cameras: list[Camera],
    world_from_cams: list[Pose],
) -> Mask:
    """Return (N, V) which patches lie aside of the epipolar lines that most of a pair's lie on.

    Args:
        points: (N, 3) landmarks, m.
        observed_px: (N, V, 2) where their patches were found, NaN where not.
        cut_from: (N,) the view that each patch is of, and is found in.
        cameras: of the V views.
        world_from_cams: likewise, off by no more than a few px.
    """
    ideal = ideal_of_pixels(observed_px, cameras)
    seen = np.isfinite(ideal[..., 0])
    out = np.zeros(seen.shape, dtype=np.bool_)
    for i, k in combinations(range(len(cameras)), 2):
        here = np.flatnonzero(seen[:, i] & seen[:, k] & ((cut_from == i) | (cut_from == k)))
        if len(here) <= N_NEIGHBOURS:
            continue
        depth = world_from_cams[i].inverse().apply(points[here])[:, 2]
        like, _ = like_neighbours(observed_px[here, i], depth, cameras[i])
        moved = world_from_cams[k].inverse() @ world_from_cams[i]
        length = float(np.linalg.norm(moved.translation))
        if length == 0.0:
            continue
        focal_px = 0.5 * (cameras[i].focal_px + cameras[k].focal_px)
        problem = relative_pose_problem(ideal[here, i], ideal[here, k], focal_px)
        aside = _aside(problem, like, Pose(moved.rotation, moved.translation / length))
        found_in = np.where(cut_from[here] == i, k, i)
        out[here[aside], found_in[aside]] = True
    return out


def _aside(problem: RelativePoseProblem, like: Mask, start: Pose) -> Mask:
    """Return (M,) which matches miss the pose that some agree on; none where these do not."""
    out = np.zeros(len(like), dtype=np.bool_)
    for _ in range(_ROUNDS):
        kept = like & ~out
        missing = _missing(problem, kept, start) if kept.sum() > N_NEIGHBOURS else None
        if missing is None:
            break
        sigmas, start = missing
        before = out
        out = sigmas > _STRAY_SIGMAS
        out[~like] |= sigmas[~like] > _believed_to(sigmas[~like])
        if (out == before).all():
            break
    return out


def _believed_to(sigmas: Array) -> float:
    """Return beyond how many sigmas landmarks are much rather wrong than right.

    A mixture of two normal distributions, by expectation maximization (A. Dempster, N. Laird,
    D. Rubin, 1977): a standard one of those that are right, a wide one of those that are not.
    """
    share, wide = 0.5, _WRONG_SIGMAS
    for _ in range(_STEPS):
        odds = np.log((1.0 - share) / share * wide)  # that one which does not miss is right
        is_wrong = expit(0.5 * sigmas**2 * (1.0 - wide**-2) - odds)
        n = is_wrong.sum()
        share = (n + _AS_IF_WRONG) / (len(sigmas) + _AS_IF_WRONG + _AS_IF_RIGHT)
        wide = max(np.sqrt((is_wrong @ sigmas**2) / max(n, _AS_IF_WRONG)), _WRONG_SIGMAS)
    odds = np.log(_LIKELIER * (1.0 - share) / share * wide)
    return float(np.sqrt(2.0 * max(odds, 0.0) / (1.0 - wide**-2)))


def _missing(problem: RelativePoseProblem, like: Mask, start: Pose) -> tuple[Array, Pose] | None:
    """Return (M,) by how many sigmas matches miss the pose that some agree on, and that pose."""
    some = replace(problem, a=problem.a[like], b=problem.b[like])
    missed_px, _ = some.linearized(start)
    noise_px = max(robust_sigma(missed_px), _NOISE_PX)
    agreed, sigma_px = some.refined(start, THRESHOLD_SIGMAS * noise_px)
    sigma_px = max(sigma_px, _LEAST_SIGMA_PX)
    error_px, slopes = problem.linearized(agreed)
    fits = like & (np.abs(error_px) < _STRAY_SIGMAS * sigma_px)
    covariance = covariance_of(problem.information(agreed, sigma_px, fits), _SINGULAR)
    if covariance is None or fits.sum() < _FITTING * like.sum():
        return None
    # Far from those that it was found of a pose's lines are known less well.
    variance = sigma_px**2 + np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    return np.asarray(np.abs(error_px) / np.sqrt(variance)), agreed
