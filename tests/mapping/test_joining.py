"""A view registered where a first pose puts the landmarks: at the place, and at one alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.views import drone_views, map_of
from tests.scenes import facade_scene
from vcl_companion.mapping.joining import Joined, join_nearby
from vcl_companion.mapping.known_features import KeyframeLibrary
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.features import Features
from vcl_companion.vision.resection import NotFound


@pytest.mark.parametrize("alike", [False, True])
def test_features_anywhere_around_vague_landmarks_are_no_place(alike: bool) -> None:
    rng = np.random.default_rng(7)
    scene = facade_scene(rng, 200, n_views=3, noise_px=0.5, turn_deg=2.0)
    views = drone_views(rng, scene, [1, 2, 3])
    # Each landmark vague by as much as the eight pixels within which it is looked for.
    known = map_of(scene, noise_px=8.0)
    known = replace(known, keyframes=tuple(
        replace(k, image_bytes=v.image_bytes) for k, v in zip(known.keyframes, views, strict=True)
    ))  # fmt: skip
    library = KeyframeLibrary(
        known, lambda k: next(v.features for v in views if v.image_bytes == k.image_bytes)
    )
    for k in range(3):
        library.of(k)
    view = replace(views[2], ned_from_body=None)
    if alike:
        (features,) = view.features
        angle, radius = (
            rng.uniform(0, 2 * np.pi, len(features)),
            7.0 * np.sqrt(rng.random(len(features))),
        )
        off = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        view = replace(view, features=(Features(features.pixels + off, features.descriptors),))
    found = join_nearby(
        view,
        scene.bodies[2],
        library,
        known,
        map_uncertainty(known),
        MapOptions(detectors=("akaze",)),
    )
    if alike:
        assert isinstance(found, NotFound)
        assert "somewhere alike" in found.reason
    else:
        assert isinstance(found, Joined), found
        assert np.linalg.norm(found.world_from_body.translation - scene.bodies[2].translation) < 0.1
