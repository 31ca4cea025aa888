"""What ``bench speed`` is measured on: a rendered scenario, the map its drones make, the truth."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np

from sitl.renderer import Renderer
from sitl.scenario import DroneInScenario, Scenario
from sitl.town import build_town
from sitl.world import World
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.fix import Prior
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.templates import Templates
from vcl_companion.vision.features import FeatureOptions, Features, Image, detect

FEATURES = FeatureOptions()
MAPPING = MapOptions()

# What a prediction is off between frames, 1 sigma: a filter's in fast flight, or a bit worse.
_PREDICTION = np.array([0.03] * 3 + [np.deg2rad(0.3)] * 3)
# What a drone believes of a frame that it has localized is off, 1 sigma.
_BELIEVED = _PREDICTION / 3.0


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of one drone, and from where it was taken.

    Attributes:
        drone_id: which drone's.
        image: (H, W) uint8.
        camera: its intrinsics.
        body_from_cam: its mounting.
        world_from_body: the truth, in the map's world.
    """

    drone_id: int
    image: Image
    camera: Camera
    body_from_cam: Pose
    world_from_body: Pose

    def predicted(self, rng: np.random.Generator) -> Prior:
        """Return a prediction that is off by as much as it says."""
        off = _PREDICTION * rng.standard_normal(6)
        return Prior(self.world_from_body.retracted(off), np.diag(_PREDICTION**2))

    def view(self, at_ns: int, detected: bool) -> DroneView:
        """Return what the drone contributes to a map.

        Args:
            at_ns: when it says that it was taken.
            detected: with features, for a first map; else with a guess of its pose.
        """
        sent = encode_image(self.image, MAPPING.keyframe_quality)
        features: tuple[Features, ...] = ()
        if detected:
            image = decode_image(sent, self.camera)
            features = tuple(detect(image, name, FEATURES) for name in MAPPING.detectors)
        guess = None
        if not detected:
            rng = np.random.default_rng([at_ns, self.drone_id])
            guess = self.world_from_body.retracted(_BELIEVED * rng.standard_normal(6))
        return DroneView(
            self.drone_id, at_ns, self.camera, self.body_from_cam,
            self.world_from_body.rotation, sent, features, guess,
        )  # fmt: skip


class Scene:
    """A scenario whose drones can be asked for an image of any instant.

    Args:
        scenario: what is rendered.
        size_px: width and height of the images, instead of the scenario's; the
            field of view across stays.
        world: what stands there, if it has been built before.
    """

    def __init__(
        self,
        scenario: Scenario,
        size_px: tuple[int, int] | None = None,
        world: World | None = None,
    ) -> None:
        if size_px is not None:
            lens = scenario.camera
            focal_px = lens.focal_px * size_px[0] / lens.width_px
            lens = msgspec.structs.replace(
                lens, width_px=size_px[0], height_px=size_px[1], focal_px=focal_px
            )
            scenario = msgspec.structs.replace(scenario, camera=lens)
        self.scenario = scenario
        self.world = world or build_town(scenario.world)
        self._paths = [drone.path() for drone in scenario.drone]
        start = self._paths[0].at(0.0).ned_from_body
        self._origin = start.translation

    def shot(self, drone: int, at_s: float) -> Shot:
        """Return what a drone sees at an instant of the flight."""
        flown: DroneInScenario = self.scenario.drone[drone]
        sensor = self.scenario.sensor(flown)
        motion = self._paths[drone].at(at_s).ned_from_body
        rng = np.random.default_rng([self.scenario.seed, drone, round(1e3 * at_s)])
        imaging = self.scenario.image.imaging(flown.gain)
        image = Renderer(self.world, sensor.camera, imaging).render(
            motion @ sensor.body_from_cam, rng
        )
        return Shot(
            drone + 1, image, sensor.camera, sensor.body_from_cam,
            Pose(motion.rotation, motion.translation - self._origin),
        )  # fmt: skip

    def placed(self, shot: Shot) -> Pose:
        """Return world_from_cam of a shot in the rendered world."""
        body = shot.world_from_body
        moved = Pose(body.rotation, body.translation + self._origin)
        return moved @ shot.body_from_cam

    def first_map(self) -> LandmarkMap:
        """Return the map that all drones make at the start.

        Raises:
            RecordingError: they cannot make one.
        """
        shots = [self.shot(i, 0.0) for i in range(len(self._paths))]
        apart = shots[0].world_from_body.translation - shots[1].world_from_body.translation
        made = reconstruct(
            [shot.view(0, detected=True) for shot in shots],
            1,
            [(1, 2, float(np.linalg.norm(apart)))],
            MAPPING,
        )
        if isinstance(made, NoMap):
            raise RecordingError(f"{self.scenario.name}: cannot be mapped: {made.reason}")
        return made


def table_bytes(index: MapIndex, templates: Templates) -> int:
    """Return the size of all arrays of a map that is ready for use, each counted once."""
    arrays: dict[int, int] = {}
    seen: set[int] = set()

    def walk(value: object) -> None:
        if id(value) in seen:
            return
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            base = value
            while isinstance(base.base, np.ndarray):
                base = base.base
            arrays[id(base)] = base.nbytes
        elif isinstance(value, bytes):
            arrays[id(value)] = len(value)
        elif isinstance(value, tuple | list):
            for inner in value:
                walk(inner)
        elif hasattr(value, "__dataclass_fields__"):
            for name in value.__dataclass_fields__:
                walk(getattr(value, name))

    walk((index, templates))
    return sum(arrays.values())
