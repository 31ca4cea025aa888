"""A drone held before the demo's houses and tilted to all sides: its images, its attitude."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from sitl.renderer import Imaging, Renderer
from sitl.scenario import load_scenario
from sitl.town import build_town
from vcl_companion.cameras.mounting import mounted_rotation
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler

LENS = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
RATE_HZ = 15.0
PERIOD_NS = 66_666_667
# A lens 12 cm before the IMU, a little up and down with what it is mounted on.
MOUNTING_DEG = (0.0, -10.0, 0.0)
BODY_FROM_CAM = Pose(mounted_rotation(MOUNTING_DEG), np.array([0.12, 0.03, -0.05]))
SECONDS = 8.0
_START = np.array([0.0, 0.0, -1.5])


def world_from_body(at_s: float) -> Pose:
    """Nods, tilts aside and turns, none like another, and moves as hands do, by centimetres."""
    roll = 0.45 * np.sin(2.1 * at_s + 0.4) * min(at_s, 1.0)
    pitch = 0.40 * np.sin(1.3 * at_s + 2.0) * min(at_s, 1.0)
    yaw = 0.50 * np.sin(0.9 * at_s) * min(at_s, 1.0)
    away = 0.05 * np.array([np.sin(1.7 * at_s), np.sin(1.1 * at_s), np.sin(2.3 * at_s)])
    return Pose(matrix_from_euler(roll, pitch, yaw), _START + away)


def folded(at_s: float) -> float:
    """The instant of ``SECONDS`` that is shown after any time: there, back, and there again."""
    return abs((at_s + SECONDS) % (2.0 * SECONDS) - SECONDS)


@functools.cache
def images(mounting_deg: tuple[float, float, float] = MOUNTING_DEG) -> list[NDArray[np.uint8]]:
    """What its camera sees, so mounted, of ``SECONDS``."""
    world = build_town(load_scenario("demo").world)
    renderer = Renderer(world, LENS, Imaging(supersampling=1))
    rng = np.random.default_rng(4)
    sits = Pose(mounted_rotation(mounting_deg), BODY_FROM_CAM.translation)
    return [
        renderer.render(world_from_body(k / RATE_HZ) @ sits, rng)
        for k in range(round(SECONDS * RATE_HZ))
    ]
