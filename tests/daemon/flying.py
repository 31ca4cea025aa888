"""A drone of a swarm that flies: its camera and the line from frame to pose beside its exchange."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from sitl.frame_server import FrameServer
from tests.daemon import demo
from tests.daemon.swarm import INTER, Drone
from tests.daemon.waiting import beside
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.daemon.catching_up import CatchingUp
from vcl_companion.daemon.companion import Companion
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.daemon.peer_poses import PeerPoses
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.swarm.group import SwarmOptions

# More landmarks than any picture has: it cannot localize itself, whatever it sees.
STARVED = LocalizationOptions(min_inliers=10_000)


@dataclass(frozen=True, eq=False)
class Flier:
    """A flying drone."""

    drone: Drone
    server: FrameServer

    def give(self, k: int) -> None:
        """Hand out its k-th picture, and its attitude before it."""
        shot = demo.shot(self.drone.system_id, k)
        self.drone.autopilot.measure(shot.at_ns, shot.ned_from_body.quaternion())
        self.server.give(self.server.n_given, shot.at_ns, demo.png(shot.image))

    def bases(self) -> list[tuple[int, str | None]]:
        """Sequence of every frame and what its sent pose relies on, as they were answered."""
        return [(line["sequence"], line["by"]) for line in self.drone.lines("frame")]

    def sources(self) -> list[tuple[int, str, str | None]]:
        """Sequence, outcome and source of every frame, as they were answered."""
        lines = self.drone.lines("frame")
        return [(line["sequence"], line["outcome"], line["source"]) for line in lines]


@contextlib.asynccontextmanager
async def flying(
    drone: Drone,
    localization: LocalizationOptions | None = None,
    *,
    searching: LocalizationOptions | None = None,
) -> AsyncIterator[Flier]:
    """Fly a drone that was started; ``STARVED`` for one that sees too little.

    ``searching`` is by what a frame is looked for on the whole map, if that is another one.
    """
    options = PipelineOptions(
        demo.FEATURES, localization or LocalizationOptions(), TrackingOptions()
    )
    sensor = demo.sensor(drone.system_id)
    size_px = (sensor.camera.width_px, sensor.camera.height_px)
    async with contextlib.AsyncExitStack() as stack:
        server = FrameServer(f"mav{drone.system_id - 1}")
        port = await server.start()
        stack.push_async_callback(server.close)
        camera = StreamCamera("127.0.0.1", port, size_px, drone.clock)
        stack.push_async_callback(camera.close)
        work = MapWork(
            demo.workshop(SwarmOptions(), sensor, INTER, searching or localization), forks=False
        )
        stack.callback(work.end)
        health = Health(drone.autopilot_link, drone.log)
        own_fixes = OwnFixes(
            sensor,
            drone.autopilot_link,
            drone.maps,
            drone.estimator,
            drone.log,
            stack.enter_context(ThreadPoolExecutor(1)),
            options,
            Odometry(sensor, drone.system_id, work),
        )
        companion = Companion(
            camera,
            FrameOutcomes(camera, drone.clock, health, drone.log),
            own_fixes,
            CatchingUp(
                drone.system_id, drone.exchange.frames, drone.maps, drone.estimator, own_fixes
            ),
            PeerPoses(drone.exchange.inter, drone.maps, drone.estimator, drone.log),
            drone.teller,
            drone.maps,
            drone.estimator,
            drone.exchange.on_frame,
            health,
            work,
            frame_wait_s=0.1,
        )
        await stack.enter_async_context(beside(companion.read_camera(), companion.run()))
        await server.connected()
        yield Flier(drone, server)
