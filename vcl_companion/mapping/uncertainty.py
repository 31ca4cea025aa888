"""How well the map is known: derived from its geometry, never transmitted (IV-F).

The joint covariance of keyframe poses and landmarks is the inverse of the
bundle adjustment's normal matrix, which needs only poses, points and who saw
what, and what observations that err in common (``misplacement``) do to the
poses. It is kept factored: each landmark has an error of its own, and one it
shares with all others through the keyframe poses. The shared part does not
average out over landmarks or frames and is what fusing must not forget. What
errs in common moves landmarks past their keyframes, too, by about as little as
it is itself; that is left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import writable
from vcl_companion.geometry.pose import adjoint
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.lens_errors import lenses_px, n_lens_causes
from vcl_companion.mapping.misplacement import N_FIELDS, misplacement
from vcl_companion.mapping.tracks import ideal_of_pixels, slopes_of_ideal
from vcl_companion.vision.bundle import (
    Distance,
    Views,
    distance_information,
    matrices_of,
    observations_of,
)
from vcl_companion.vision.information import covariance_of
from vcl_companion.vision.joint_kernels import joined, without_points
from vcl_companion.vision.schur import carried

# Smallest eigenvalue of an information matrix with ones on its diagonal; eliminating
# landmarks of little parallax leaves 1e-12 by rounding.
_SINGULAR = 1e-11
_WIDER = 3.5
# No distance between drones is known better; much smaller sigmas overflow.
_FINEST_M = 1e-6
# So many landmarks are dealt with at a time: on its way what is known of one takes several times
# the memory that it takes in the end.
_AT_A_TIME = 192


@dataclass(frozen=True, eq=False)
class MapUncertainty:
    """The joint covariance of a map, factored.

    Attributes:
        keyframe_covariance: (6V, 6V) of the keyframe bodies, local perturbations.
        landmark_covariance: (N, 3, 3) of each landmark were the keyframes exact, m^2.
        landmark_lever: (N, 3, 6V) landmark error per keyframe error.
        calibration_px: what lenses were taken to be off (``lens_errors``); 0 for exact ones.
        alike_px: what the patches of a frame are off together, anew in each, smoothly over the
            image as a lens is.
    """

    keyframe_covariance: Array
    landmark_covariance: Array
    landmark_lever: NDArray[np.float32]
    calibration_px: float = 0.0
    alike_px: float = 0.0

    def marginal(self) -> Array:
        """Return (N, 3, 3) the whole covariance of each landmark, m^2."""
        return self._with_shared(np.arange(len(self.landmark_lever), dtype=np.int64), 1.0)

    def seen_from(self, keyframes: tuple[Keyframe, ...], by: NDArray[np.intp]) -> Array:
        """Return (N, 3, 3) how well it is known where each landmark is from a keyframe, m^2.

        However far both are from where the world begins, or vague together.

        Args:
            keyframes: the map's.
            by: (N,) from which of them.
        """
        lever = self.landmark_lever.copy()
        for i, keyframe in enumerate(keyframes):
            own = slice(6 * i, 6 * i + 3)
            lever[by == i, :, own] -= keyframe.world_from_body.rotation.astype(np.float32)
        landmarks = np.arange(len(lever), dtype=np.int64)
        shared = carried(lever, self.keyframe_covariance, landmarks)
        return np.asarray(shared + self.landmark_covariance)

    def for_matching(self, landmarks: NDArray[np.int64]) -> Array:
        """Return (M, 3, 3) covariances that tell sightings of some landmarks from wrong ones.

        The error that they share is taken for more than it is: where a wide step ends a map, all
        new views hang on the few landmarks that such a gate lets in.
        """
        return self._with_shared(landmarks, _WIDER)

    def _with_shared(self, landmarks: NDArray[np.int64], factor: float) -> Array:
        out = carried(self.landmark_lever, self.keyframe_covariance, landmarks)
        out *= factor**2
        out += self.landmark_covariance[landmarks]
        return out


def _portions(n: int) -> Iterator[slice]:
    for begin in range(0, n, _AT_A_TIME):
        yield slice(begin, min(begin + _AT_A_TIME, n))


def views_of(landmark_map: LandmarkMap) -> Views:
    """Return the map as the bundle adjustment sees it."""
    keyframes = landmark_map.keyframes
    cameras = [k.camera for k in keyframes]
    ideal = ideal_of_pixels(landmark_map.observed_px, cameras)
    return Views(
        bodies=tuple(k.world_from_body for k in keyframes),
        mountings=tuple(k.body_from_cam for k in keyframes),
        slopes=slopes_of_ideal(ideal, cameras),
        ideal=ideal,
        points=landmark_map.points_world,
        distances=distances_of(landmark_map.distances),
    )


def distances_of(known: tuple[KnownDistance, ...]) -> tuple[Distance, ...]:
    """Return known distances as the bundle adjustment sees them."""
    return tuple(Distance(d.keyframe_a, d.keyframe_b, d.distance_m, d.sigma_m) for d in known)


def map_uncertainty(landmark_map: LandmarkMap, calibration_px: float = 0.0) -> MapUncertainty:
    """Compute the joint covariance of keyframes and landmarks.

    Args:
        landmark_map: any revision.
        calibration_px: what every drone's lens may be off (``lens_errors``), 1 sigma.

    Raises:
        ValueError: the map's observations do not fix it (no known distance, a
            keyframe that shares nothing, a landmark seen once), or a distance
            is claimed to be exact.
    """
    if not all(distance.sigma_m >= _FINEST_M for distance in landmark_map.distances):
        raise ValueError("the map claims to know a distance exactly")
    # A map may come from a peer: whatever its numbers are, they only fail the tests below.
    n, n_keyframes = len(landmark_map.points_world), len(landmark_map.keyframes)
    inverse = np.empty((n, 3, 3))
    # In the order in which compiled loops were compiled for it. It is the largest part of a
    # map of many keyframes, and a millionth of it is no matter.
    lever = np.zeros((n, 3, 6 * n_keyframes), dtype=np.float32)
    reduced = distance_information(views_of(landmark_map.of_landmarks(slice(0, 0))))
    n_causes = N_FIELDS + (n_lens_causes(landmark_map) if calibration_px else 0)
    pulls = np.zeros((6 * n_keyframes, n_causes))
    bodies = matrices_of([k.world_from_body for k in landmark_map.keyframes])
    mountings = matrices_of([k.body_from_cam for k in landmark_map.keyframes])
    with np.errstate(all="ignore"):
        for some in _portions(n):
            part = landmark_map.of_landmarks(some)
            seen, views = part.seen, views_of(part)
            first, view = observations_of(seen)
            noise_px, errors_px = misplacement(part)
            if calibration_px:
                by_lenses = lenses_px(part, calibration_px)
                errors_px = np.concatenate([errors_px, by_lenses], axis=2)
            noise = noise_px[:, None, None]
            errors_px /= noise
            # Pixels in units of their own sigma, as distances are.
            normal, of_points, crosses, view_pulls, point_pulls = joined(
                writable(part.points_world), bodies, mountings, first, view,
                views.slopes[seen] / noise, views.ideal[seen], errors_px,
            )  # fmt: skip
            inverse[some] = _inverse(of_points)
            without_points(
                first, view, crosses, inverse[some], point_pulls, normal, view_pulls, lever[some]
            )
            reduced += normal
            pulls += view_pulls
        covariance = np.zeros_like(reduced)
        covariance[6:, 6:] = _inverse(reduced[6:, 6:])
        # An adjustment that knows nothing of what errs in common is moved by it: considered, not
        # estimated (Bierman, Factorization Methods for Discrete Sequential Estimation, VIII).
        carried_off = covariance @ pulls
        covariance += carried_off @ carried_off.T
        if landmark_map.anchor_covariance.any():
            # Whatever the first keyframe is off by, all are, and so are the landmarks.
            poses = [keyframe.world_from_body for keyframe in landmark_map.keyframes]
            as_first = np.vstack([adjoint(pose.inverse() @ poses[0]) for pose in poses])
            covariance += as_first @ landmark_map.anchor_covariance @ as_first.T
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the map's observations do not fix it")
    return MapUncertainty(covariance, inverse, lever, calibration_px)


def _inverse(information: Array) -> Array:
    """Return the inverses of (..., K, K) information matrices.

    Raises:
        ValueError: one of them is not positive definite, or hardly is.
    """
    inverse = covariance_of(information, _SINGULAR)
    if inverse is None:
        raise ValueError("the map's observations do not fix it")
    return inverse
