"""Writes down every second how the service is, for ``vcl status``."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from concurrent.futures import Executor
from pathlib import Path

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.status import (
    AutopilotStatus,
    MapStatus,
    ServiceStatus,
    write_status,
)
from vcl_companion.errors import reason_of
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.swarm.group import Group

_log = logging.getLogger(__name__)

_EVERY_S = 1.0


class StatusWriter:
    """Gathers what is to be said; everything but the writing happens in the loop's thread.

    Args:
        path: the file.
        system_id: this drone.
        health: how the service is.
        autopilot: what becomes of our poses.
        estimator: where we are.
        maps: what we fly on.
        group: who is there.
        executor: writes.
    """

    def __init__(
        self,
        path: Path,
        system_id: int,
        health: Health,
        autopilot: AutopilotLink,
        estimator: Estimator,
        maps: MapStore,
        group: Group,
        executor: Executor,
    ) -> None:
        self._path = path
        self._system_id = system_id
        self._health = health
        self._autopilot = autopilot
        self._estimator = estimator
        self._maps = maps
        self._group = group
        self._executor = executor

    async def run(self) -> None:
        """Write until cancelled; a disk that cannot be written to is told of once."""
        loop = asyncio.get_running_loop()
        is_told = False
        while True:
            try:
                await loop.run_in_executor(self._executor, write_status, self._path, self.status())
                is_told = False
            except (OSError, ValueError) as error:
                if not is_told:
                    why = reason_of(error)
                    _log.warning("%s: %s: no status is written", self._path, why)
                is_told = True
            await asyncio.sleep(_EVERY_S)

    def status(self) -> ServiceStatus:
        """Return how the service is now."""
        fusion, ahead_s = self._autopilot.fusion(), self._autopilot.ahead_s
        round_trip_s = self._autopilot.attitudes.round_trip_s
        stored, sigma_m = self._maps.current, self._estimator.sigma_m
        return ServiceStatus(
            self._system_id,
            time.time(),
            self._health.state.name.lower(),
            self._health.text,
            sigma_m if math.isfinite(sigma_m) else None,
            AutopilotStatus(
                self._autopilot.firmware.value,
                fusion.state.value,
                fusion.reason if self._autopilot.is_heard else "it is not heard",
                None if ahead_s is None else 1e3 * ahead_s,
                None if round_trip_s is None else 1e3 * round_trip_s,
            ),
            None
            if stored is None
            else MapStatus(
                stored.revision.hex(),
                len(stored.index.landmark_map.points_world),
                len(stored.index.landmark_map.keyframes),
            ),
            self._group.alive,
            self._group.coordinator,
        )
