"""What a pilot may change in flight, as MAVLink parameters; nothing of it outlasts a restart.

    VCL_PAUSED       1: no poses are sent; the same as MAV_CMD_USER_5
    VCL_POSE_AGE     autopilot.max_pose_age_s
    VCL_TIME_ERR     autopilot.time_error_s
    VCL_UPD_TRACKED  update.tracked; this and VCL_UPD_SHARE 0: this drone wants no updates
    VCL_UPD_SHARE    update.share
    VCL_UPD_COVERED  update.covered
    VCL_UPD_NOVELTY  update.novelty_deg
    VCL_UPD_SIGMA    update.sigma_m
    VCL_UPD_GROWTH   update.sigma_growth

Bounds are those of the configuration. The others are read when the service starts, by processes
that it has forked off, or have to be the same on all drones at every moment.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

from vcl_companion.daemon.commands import Commands
from vcl_companion.daemon.exchange import Exchange
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.own_messages import parameter_value
from vcl_companion.links.own_parameters import OwnParameters, Setting
from vcl_companion.links.texts import Severity

_log = logging.getLogger(__name__)

_PAUSED = "VCL_PAUSED"
_POSES = {"VCL_POSE_AGE": "max_pose_age_s", "VCL_TIME_ERR": "time_error_s"}
_UPDATES = {
    "VCL_UPD_TRACKED": "tracked",
    "VCL_UPD_SHARE": "share",
    "VCL_UPD_COVERED": "covered",
    "VCL_UPD_NOVELTY": "novelty_deg",
    "VCL_UPD_SIGMA": "sigma_m",
    "VCL_UPD_GROWTH": "sigma_growth",
}
_WHOLE = ("tracked",)


def open_settings(
    autopilot: AutopilotLink,
    exchange: Exchange,
    commands: Commands,
    log: FlightLog,
) -> OwnParameters:
    """Have the settings of a running service answered for over the autopilot's link.

    Args:
        autopilot: sends poses.
        exchange: votes for updates.
        commands: hold poses back, and send them again.
        log: told of every change.
    """

    def changed(name: str, value: float, by: int) -> None:
        log.event("setting", f"{name} {value:g}, by system {by}")
        _log.info("system %d sets %s to %g", by, name, value)

    def refused(name: str, why: str) -> None:
        autopilot.announce(Severity.WARNING, f"{name}: {why}")
        _log.warning("%s stays as it is: %s", name, why)

    parameters = OwnParameters(
        tuple(_settings(autopilot, exchange, commands.pause)),
        lambda name, value, n, index: autopilot.send(parameter_value(name, value, n, index)),
        changed,
        refused,
    )
    autopilot.on_parameter = parameters.take
    # Ground stations ask once, and show what they were told last.
    commands.on_pause = lambda: parameters.tell(_PAUSED)
    return parameters


def _settings(
    autopilot: AutopilotLink, exchange: Exchange, pause: Callable[[bool], None]
) -> Iterator[Setting]:
    def set_paused(value: float) -> None:
        if value not in (0.0, 1.0):
            raise ValueError(f"must be 0 or 1, got {value:g}")
        if bool(value) != autopilot.poses.is_paused:
            pause(bool(value))

    def of_poses(field: str) -> float:
        return float(getattr(autopilot.options, field))

    def set_of_poses(field: str, value: float) -> None:
        change: dict[str, Any] = {field: value}
        autopilot.options = replace(autopilot.options, **change)

    def of_updates(field: str) -> float:
        return float(getattr(exchange.update_options, field))

    def set_of_updates(field: str, value: float) -> None:
        if field in _WHOLE and not value.is_integer():
            raise ValueError(f"{field} must be a whole number, got {value:g}")
        change: dict[str, Any] = {field: int(value) if field in _WHOLE else value}
        exchange.update_options = replace(exchange.update_options, **change)

    yield Setting(_PAUSED, lambda: float(autopilot.poses.is_paused), set_paused)
    for name, field in _POSES.items():
        yield Setting(name, partial(of_poses, field), partial(set_of_poses, field))
    for name, field in _UPDATES.items():
        yield Setting(name, partial(of_updates, field), partial(set_of_updates, field))
