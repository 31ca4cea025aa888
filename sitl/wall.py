"""Small real images that show one thing, and a map of it: a picture on a wall.

Cut out of an image of the embedded demo, so that their features are those of a camera.
The drones hover before the picture and look at it squarely: what one sees lies in
another's image by so many pixels.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import cv2
import numpy as np

from sitl.embedded import DEMO
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import ImageFormat, decode_image, encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD, Sensor
from vcl_companion.vision.features import FeatureOptions, Image, detect

SIZE_PX = (128, 96)
_FOCAL_PX = 110.0
CAMERA = Camera(*SIZE_PX, _FOCAL_PX, _FOCAL_PX, (SIZE_PX[0] - 1) / 2, (SIZE_PX[1] - 1) / 2)
SENSOR = Sensor(CAMERA, Pose(BODY_FROM_CAM_FORWARD, np.zeros(3)), 5.0)
_WALL_M = 8.0
_MOST_OFF_PX = 40
_QUALITY = 30
_MOST_LANDMARKS = 60


@functools.cache
def _pictures() -> tuple[Image, ...]:
    files = [DEMO / f"mav{k}" / "cam0" / "data" / "1760000000000000000.jpg" for k in range(3)]
    images = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files]
    return tuple(np.asarray(image, dtype=np.uint8) for image in images if image is not None)


class Scene:
    """One picture on a wall, seen from the places of a few drones; see the module.

    Args:
        rng: which picture, and where they hover.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        pictures = _pictures()
        picture = pictures[int(rng.integers(len(pictures)))]
        height, width = picture.shape
        x = int(rng.integers(_MOST_OFF_PX, width - SIZE_PX[0] - _MOST_OFF_PX))
        y = int(rng.integers(_MOST_OFF_PX, height - SIZE_PX[1] - _MOST_OFF_PX))
        self._picture, self._first_px = picture, (x, y)
        self._rng = rng

    def place(self) -> tuple[int, int]:
        """Return a place to hover at, by how far off what is seen from there is, px."""
        across, down = self._rng.integers(-_MOST_OFF_PX, _MOST_OFF_PX + 1, 2)
        return int(across), int(down)

    def image(self, place: tuple[int, int]) -> Image:
        """Return what a camera sees from there."""
        x, y = self._first_px[0] + place[0], self._first_px[1] + place[1]
        return np.ascontiguousarray(self._picture[y : y + SIZE_PX[1], x : x + SIZE_PX[0]])

    def encoded(self, place: tuple[int, int], image_format: ImageFormat = "av1") -> bytes:
        """Return that as it travels."""
        return encode_image(self.image(place), _QUALITY, image_format=image_format)

    def world_from_body(self, place: tuple[int, int]) -> Pose:
        """Return where a drone is that hovers there."""
        step_m = _WALL_M / _FOCAL_PX
        return Pose(np.eye(3), np.array([0.0, place[0] * step_m, place[1] * step_m]))

    def first_map(self, drones: tuple[int, ...]) -> LandmarkMap:
        """Return a map of one image of each of some drones."""
        places = [(0, 0), *(self.place() for _ in drones[1:])]
        keyframes = tuple(self._keyframe(d, p) for d, p in zip(drones, places, strict=True))
        pixels = detect(
            decode_image(keyframes[0].image_bytes, CAMERA), "akaze", FeatureOptions()
        ).pixels[:_MOST_LANDMARKS]
        points = self._points(pixels)
        base_m = float(np.linalg.norm(keyframes[1].world_from_body.translation))
        distances = (KnownDistance(0, 1, base_m, 0.01),) if base_m > 0.0 else ()
        seen = np.stack([_seen(pixels - np.array(place)) for place in places], axis=1)
        return LandmarkMap(keyframes, points, seen, 0.5, ("akaze",), distances, b"")

    def next_map(self, parent: LandmarkMap, revision: bytes, drone: int) -> LandmarkMap:
        """Return a map that goes on from another: one image more, the landmarks moved a little."""
        place = self.place()
        moved = parent.points_world + self._rng.normal(0.0, 1e-3, parent.points_world.shape)
        pixels = self._pixels(parent.points_world) - np.array(place)
        return replace(
            parent,
            keyframes=(*parent.keyframes, self._keyframe(drone, place)),
            points_world=moved,
            observed_px=np.concatenate([parent.observed_px, _seen(pixels)[:, None]], axis=1),
            parent=revision,
        )

    def _keyframe(self, drone: int, place: tuple[int, int]) -> Keyframe:
        at_ns = int(self._rng.integers(1 << 40))
        pose = self.world_from_body(place)
        return Keyframe(drone, at_ns, pose, SENSOR.body_from_cam, CAMERA, self.encoded(place))

    def _points(self, pixels: Array) -> Array:
        off = (pixels - np.array([CAMERA.cx_px, CAMERA.cy_px])) * _WALL_M / _FOCAL_PX
        return np.column_stack([np.full(len(pixels), _WALL_M), off])

    def _pixels(self, points_world: Array) -> Array:
        centre = np.array([CAMERA.cx_px, CAMERA.cy_px])
        return np.asarray(points_world[:, 1:] * _FOCAL_PX / _WALL_M + centre)


def _seen(pixels: Array) -> Array:
    """Return (N, 2) pixels, not a number outside of the image."""
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(SIZE_PX) - 1), axis=1)
    return np.where(np.asarray(inside)[:, None], pixels, np.nan)
