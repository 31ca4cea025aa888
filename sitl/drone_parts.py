"""What of a daemon deals with peers, put together without its camera, its autopilot, its socket.

Exchange, group, transfers, map store, workshop and estimator are those of a flight, as
``daemon/assemble.py`` puts them together; for an event loop that does an executor's work at
once (``counted_loop``), and with the small images of ``wall``.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from sitl.wall import SENSOR
from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.exchange import Exchange, ExchangeOptions
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.options import MapOptions
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.quarantine import QuarantineOptions
from vcl_companion.swarm.transfer import Transfers
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.vision.features import Detector, FeatureOptions

DETECTORS: tuple[Detector, ...] = ("akaze",)


class DroneParts:
    """One drone's; the owner runs ``exchange.run`` and gives it a link.

    Args:
        own: its system id.
        swarm: the group it is in.
        transfers: its own.
        building: of maps.
        inter: of poses by peers.
        clock: its time.
        rng: numbers its requests.
        quarantine: when a peer is not believed any more; None: as in a flight.

    Attributes:
        group: who is there, as far as it knows.
        maps: what it flies on.
        estimator: where it is.
        exchange: its dealings with its peers.
    """

    def __init__(
        self,
        own: int,
        swarm: SwarmOptions,
        transfers: Transfers,
        building: MapOptions,
        inter: InterMavOptions,
        clock: Clock,
        rng: np.random.Generator,
        quarantine: QuarantineOptions | None = None,
    ) -> None:
        self.group = Group(swarm, own)
        self.maps = MapStore("")
        self.estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda why: None)
        pipeline = PipelineOptions(FeatureOptions(), LocalizationOptions(), TrackingOptions())
        work = WorkOptions(
            swarm.known_distances, building, pipeline, DETECTORS, inter, tracked=True
        )
        self._work = MapWork(Workshop(SENSOR, work), forks=False)
        self._disk = ThreadPoolExecutor(1)  # begins no thread: see ``CountedLoop``
        self.exchange = Exchange(
            own, self.group, transfers, self.maps,
            AutopilotLink(AutopilotOptions("udp:127.0.0.1:9"), own, clock), SENSOR, clock,
            FlightLog("", clock), self._work, self._disk, self.estimator,
            ExchangeOptions(
                swarm, building, UpdateOptions(), DETECTORS, inter, tracked=True,
                quarantine=quarantine or QuarantineOptions(),
            ),
            rng,
        )  # fmt: skip

    def end(self) -> None:
        """Stop what works."""
        self._work.end()
        self._disk.shutdown()
