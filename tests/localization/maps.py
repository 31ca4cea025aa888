"""Maps ready for localization, and what a camera sees of them: descriptors instead of images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.mapping.views import descriptors_of, map_of
from tests.scenes import Scene, facade_scene, observe
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.features import Features

Descriptors = NDArray[np.uint8]


def index_of(landmark_map: LandmarkMap, descriptors: Descriptors) -> MapIndex:
    """Return the index of a map whose landmark j has descriptor j in every keyframe."""
    uncertainty = map_uncertainty(landmark_map)
    owner, i = np.nonzero(landmark_map.seen)
    return MapIndex(
        landmark_map,
        uncertainty,
        uncertainty.marginal(),
        Features(landmark_map.observed_px[owner, i], descriptors[owner]),
        owner.astype(np.intp),
        "akaze",
    )


def index_of_scene(
    rng: np.random.Generator, scene: Scene, sigma_m: float = 0.01
) -> tuple[MapIndex, Descriptors]:
    """Return the index of an exact map of a scene, and its landmarks' descriptors."""
    landmark_map = map_of(scene, sigma_m)
    descriptors = descriptors_of(rng, len(landmark_map.points_world))
    return index_of(landmark_map, descriptors), descriptors


def seen_from(
    rng: np.random.Generator,
    landmark_map: LandmarkMap,
    descriptors: Descriptors,
    world_from_body: Pose,
    *,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    missed: float = 0.0,
) -> Features:
    """Return the features of an image taken from a pose by the first keyframe's camera."""
    first = landmark_map.keyframes[0]
    view = observe(
        rng,
        landmark_map.points_world,
        (world_from_body,),
        (first.body_from_cam,),
        first.camera,
        noise_px=noise_px,
        outliers=outliers,
        missed=missed,
    )
    seen = rng.permutation(np.flatnonzero(view.seen[:, 0]))
    return Features(view.observed_px[seen, 0], descriptors[seen])


def flat_map(rng: np.random.Generator, half_m: float, n: int = 80) -> LandmarkMap:
    """A map of n landmarks on a square of a facade 12 m ahead."""
    scene = facade_scene(rng, n, relief_m=0.0, n_views=3)
    across = rng.uniform(-half_m, half_m, (n, 2))
    points = np.column_stack([np.full(n, 12.0), across])
    cams = [body @ mounting for body, mounting in zip(scene.bodies, scene.mountings, strict=True)]
    seen = np.stack([scene.camera.project(cam.inverse().apply(points)) for cam in cams], axis=1)
    return replace(map_of(scene, 0.01), points_world=points, observed_px=seen)
