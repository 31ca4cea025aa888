"""An image that is there again is news of a drone that stands, and none of one that moves."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from tests.localization.filter_flights import fix_at
from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.frozen_camera import FrozenCamera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.pose_filter import FilterOptions, predict, started, update

STEP_NS = 100_000_000
NORTH = np.array([1.0, 0.0, 0.0])


class Drone:
    """A camera of ten images a second, an attitude, and a filter that has followed it so far."""

    def __init__(self, speed_m_s: float, n_images: int = 20) -> None:
        self.rng = np.random.default_rng(3)
        self.image = self.seen()
        self.k = -1
        self.ned_from_body: Array | None = np.eye(3)
        self.said: list[Array | None] = []
        self.frozen = FrozenCamera(self.attitude_at, self.predicted)
        pose = Pose.identity()
        self.state = started(fix_at(pose), 0, self.ned_from_body, FilterOptions())
        assert [self.gives(new=True) for _ in range(n_images)] == [False] * n_images
        for k in range(1, n_images):
            pose = Pose(np.eye(3), NORTH * (speed_m_s * k * 0.1))
            predicted = self.predicted(k * STEP_NS, self.ned_from_body)
            assert predicted is not None
            after = update(predicted, fix_at(pose))
            assert isinstance(after, FilterState)
            self.state = after

    def seen(self) -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
        return self.rng.integers(0, 256, (48, 64), dtype=np.uint8)

    async def attitude_at(self, at_ns: int) -> Array | None:
        return self.said[at_ns // STEP_NS]

    def predicted(self, at_ns: int, ned_from_body: Array | None) -> FilterState | None:
        return predict(self.state, at_ns, ned_from_body, FilterOptions())

    def gives(self, *, new: bool = False, turned_deg: float = 0.0) -> bool:
        """Take the next image, or the last one once more; whether that is told to be no news."""
        if turned_deg:
            assert self.ned_from_body is not None
            turned = exp_so3(np.array([0.0, 0.0, np.deg2rad(turned_deg)]))
            self.ned_from_body = self.ned_from_body @ turned
        if new:
            self.image = self.seen()
        self.k += 1
        self.said.append(self.ned_from_body)
        frame = Frame(self.image.copy(), self.k * STEP_NS, self.k, 0)
        return asyncio.run(self.frozen.has_given(frame))


def test_an_image_of_a_drone_in_flight_is_not_there_again() -> None:
    drone = Drone(speed_m_s=3.0)
    assert drone.gives()
    assert drone.gives()
    assert not drone.gives(new=True)


def test_an_image_of_a_drone_that_stands_may_be() -> None:
    drone = Drone(speed_m_s=0.0)
    rng = np.random.default_rng(1)
    for _ in range(100):
        drone.ned_from_body = exp_so3(np.deg2rad(0.1) * rng.standard_normal(3))
        assert not drone.gives()


def test_nor_of_one_that_turns() -> None:
    """However slowly: what the camera gave in between is not asked about once more."""
    drone = Drone(speed_m_s=0.0)
    told = [drone.gives(turned_deg=0.3) for _ in range(12)]
    assert told == [False] * 3 + [True] * 9


def test_one_that_stops_at_once_is_believed_when_it_has_not_turned_for_two_seconds() -> None:
    drone = Drone(speed_m_s=3.0)
    assert [drone.gives() for _ in range(24)] == [True] * 20 + [False] * 4
    drone = Drone(speed_m_s=3.0)
    assert all(drone.gives(turned_deg=1.1 if k % 10 == 5 else 0.0) for k in range(60))


def test_one_that_brakes_may_stand() -> None:
    """A speed that it may have lost since is none."""
    assert not Drone(speed_m_s=0.3).gives()


def test_without_an_attitude_its_speed_alone_tells() -> None:
    drone = Drone(speed_m_s=3.0)
    drone.ned_from_body = None
    assert all(drone.gives() for _ in range(40))
    assert not drone.gives(new=True)
    drone = Drone(speed_m_s=0.0)
    drone.ned_from_body = None
    assert not any(drone.gives() for _ in range(40))


@pytest.mark.parametrize("at", [(0, 0), (47, 63), (17, 5)])
def test_an_image_that_differs_in_one_pixel_is_a_new_one(at: tuple[int, int]) -> None:
    drone = Drone(speed_m_s=3.0)
    drone.image = drone.image.copy()
    drone.image[at] ^= 1
    assert not drone.gives()
    assert drone.gives()
