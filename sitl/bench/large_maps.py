"""Maps of any size, for ``bench speed``: rendered places side by side, landmarks by the truth.

A map of a hundred thousand landmarks cannot be flown in minutes. Each place is the same
town with other looks, seen by two drones; its landmarks are the features found in their
images, at the rendered depth. The places stand apart, so that a frame shows one of them;
far points that only exist as numbers tie each place to the next, as a map must hang together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from sitl.bench.speed_scene import MAPPING, Scene, Shot
from sitl.renderer import Renderer
from sitl.scenario import Scenario
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.vision.features import FeatureOptions, detect

Mask = NDArray[np.bool_]

# More than a daemon looks for: fewer places to render.
MANY_FEATURES = FeatureOptions(max_features=4000)

_APART_M = 250.0
_FAR_M = 1500.0
_N_TIES = 200
_NOISE_PX = 0.2
_SAME_DEPTH = 0.03
_SAME_PX = 2.0


@dataclass(frozen=True, eq=False)
class Place:
    """Two keyframes and the landmarks that both see.

    Attributes:
        scene: to render more of it.
        keyframes: two, in the map's world.
        points: (N, 3) m, in the map's world, in the order in which small maps take them.
        pixels: (N, 2, 2) where each keyframe sees them.
    """

    scene: Scene
    keyframes: tuple[Keyframe, Keyframe]
    points: Array
    pixels: Array


def places(scenario: Scenario) -> Iterator[Place]:
    """Yield place after place without end, the first at the world's origin."""
    number = 0
    while True:
        town = scenario.world
        if number:
            town = msgspec.structs.replace(town, seed=town.seed + 1000 * number)
        scene = Scene(msgspec.structs.replace(scenario, world=town))
        yield _place(scene, number)
        number += 1


def large_map(of: list[Place], n_landmarks: int) -> LandmarkMap:
    """Return a map of so many landmarks, ties aside, from the first places that have as many."""
    rng = np.random.default_rng(n_landmarks)
    keyframes: list[Keyframe] = []
    points, pixels, columns = [], [], []
    left = n_landmarks
    for place in of:
        if left <= 0:
            break
        if keyframes:
            tied, seen = _ties(keyframes[-2], place.keyframes[0], rng)
            points.append(tied)
            pixels.append(seen)
            columns.append((len(keyframes) - 2, len(keyframes)))
        n = min(left, len(place.points))
        points.append(place.points[:n])
        pixels.append(place.pixels[:n])
        columns.append((len(keyframes), len(keyframes) + 1))
        keyframes += place.keyframes
        left -= n
    observed = np.full((sum(map(len, points)), len(keyframes), 2), np.nan)
    row = 0
    for seen, (a, b) in zip(pixels, columns, strict=True):
        observed[row : row + len(seen), a] = seen[:, 0]
        observed[row : row + len(seen), b] = seen[:, 1]
        row += len(seen)
    bodies = [keyframe.world_from_body.translation for keyframe in keyframes]
    # Two views leave the scale open: those of one place, and those tied.
    known = tuple(
        KnownDistance(a, b, float(np.linalg.norm(bodies[a] - bodies[b])), 0.01) for a, b in columns
    )
    return LandmarkMap(
        tuple(keyframes), np.concatenate(points), observed, _NOISE_PX, ("akaze",), known, b""
    )


def _place(scene: Scene, number: int) -> Place:
    offset = np.array([0.0, _APART_M * number, 0.0])
    shots = [scene.shot(i, 0.0) for i in range(2)]
    sides = [_Side(scene, shot, offset) for shot in shots]
    rng = np.random.default_rng(number)
    points, pixels = np.empty((0, 3)), np.empty((0, 2, 2))
    for own, other in ((0, 1), (1, 0)):
        a, b = sides[own], sides[other]
        found, there, seen = a.landmarks()
        elsewhere, visible = b.shows(there)
        if len(points):
            # What the other side has found already is no second landmark.
            apart = np.linalg.norm(found[seen][:, None] - pixels[None, :, own], axis=2)
            visible[seen] &= apart.min(axis=1) > _SAME_PX
        kept = seen & visible
        both = np.empty((int(kept.sum()), 2, 2))
        both[:, own] = found[kept]
        both[:, other] = elsewhere[kept] + _NOISE_PX * rng.standard_normal((len(both), 2))
        points, pixels = np.concatenate([points, there[kept]]), np.concatenate([pixels, both])
    order = rng.permutation(len(points))
    return Place(scene, (sides[0].keyframe, sides[1].keyframe), points[order], pixels[order])


class _Side:
    """One drone's view of a place."""

    def __init__(self, scene: Scene, shot: Shot, offset: Array) -> None:
        sent = encode_image(shot.image, MAPPING.keyframe_quality)
        self.keyframe = Keyframe(
            shot.drone_id, 0, Pose(shot.world_from_body.rotation,
            shot.world_from_body.translation + offset), shot.body_from_cam, shot.camera, sent,
        )  # fmt: skip
        self._shot = shot
        self._pose = self.keyframe.world_from_body @ shot.body_from_cam
        renderer = Renderer(scene.world, shot.camera)
        self._depth = renderer.depth(scene.placed(shot)).depth_m

    def landmarks(self) -> tuple[Array, Array, Mask]:
        """Return pixels (N, 2) of features, the points (N, 3) there, and which are not sky."""
        camera = self._shot.camera
        image = decode_image(self.keyframe.image_bytes, camera)
        pixels = detect(image, "akaze", MANY_FEATURES).pixels
        depth = self._at(pixels)
        seen = np.isfinite(depth)
        rays = np.column_stack([camera.ideal_from_pixels(pixels), np.ones(len(pixels))])
        return pixels, self._pose.apply(rays * np.where(seen, depth, 1.0)[:, None]), seen

    def shows(self, points: Array) -> tuple[Array, Mask]:
        """Return where points appear, (N, 2), and whether they do, with nothing before them."""
        there = self._pose.inverse().apply(points)
        camera = self._shot.camera
        with np.errstate(invalid="ignore", divide="ignore"):
            pixels = camera.project(there)
            size = np.array([camera.width_px, camera.height_px])
            inside = ((pixels >= 0.0) & (pixels <= size - 1.0)).all(axis=1) & (there[:, 2] > 0.1)
        depth = self._at(np.where(inside[:, None], pixels, 0.0))
        with np.errstate(invalid="ignore"):
            inside &= np.abs(depth - there[:, 2]) < _SAME_DEPTH * there[:, 2]
        return pixels, inside

    def _at(self, pixels: Array) -> Array:
        at = np.rint(pixels).astype(np.intp)
        return np.asarray(self._depth[at[:, 1], at[:, 0]], dtype=np.float64)


def _ties(a: Keyframe, b: Keyframe, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return far points that two keyframes would see, (N, 3), and where, (N, 2, 2)."""
    centre = 0.5 * (a.world_from_body.translation + b.world_from_body.translation)
    ahead = a.world_from_body @ a.body_from_cam
    across, down, along = ahead.rotation.T
    spread = 0.3 * _FAR_M * rng.uniform(-1.0, 1.0, (_N_TIES, 2))
    points = centre + _FAR_M * rng.uniform(0.5, 1.0, (_N_TIES, 1)) * along
    points = points + spread[:, :1] * across + spread[:, 1:] * down
    seen = [
        k.camera.project((k.world_from_body @ k.body_from_cam).inverse().apply(points))
        for k in (a, b)
    ]
    return points, np.stack(seen, axis=1)
