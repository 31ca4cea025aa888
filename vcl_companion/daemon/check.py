"""``vcl check``: before flight, what keeps the service or the autopilot from working together.

The service must not run meanwhile: the check uses its links and its camera.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import asdict, dataclass

from vcl_companion.cameras.mounting import read_calibration
from vcl_companion.cameras.open import open_camera
from vcl_companion.clock import Clock, SystemClock
from vcl_companion.config import Config
from vcl_companion.daemon.check_axes import judge_axes
from vcl_companion.daemon.check_host import Check, Grade, of_camera, of_files, of_wall_clock
from vcl_companion.daemon.check_motion import watch_motion
from vcl_companion.daemon.frame_rules import of_frames
from vcl_companion.daemon.parameter_rules import Finding, findings, names_of, rules_for
from vcl_companion.errors import ConfigError, VclError
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.vision_pose import Firmware

_HEARTBEAT_S = 5.0
_STREAM_S = 2.5
_LEAST_ATTITUDE_SHARE = 0.5
_ROUND_TRIP_S = 0.05
# So many of the parameters that are asked for first every autopilot of its firmware has.
_ALL_HAVE = 2
# How long somebody may take to turn the drone to all sides.
TILT_S = 40.0
_GRADE_OF: dict[str, Grade] = {
    "dangerous": "failure",
    "prevents": "failure",
    "warns": "warning",
}


@dataclass(frozen=True)
class Outcome:
    """All that was looked at, and the parameters that could be mended."""

    checks: tuple[Check, ...]
    wrong: tuple[Finding, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether nothing failed."""
        return all(check.grade != "failure" for check in self.checks)


async def check_all(config: Config, tilt: Callable[[], None] | None = None) -> Outcome:
    """Look at everything; what cannot be looked at is a failure of its own.

    Args:
        config: of the daemon.
        tilt: asks somebody to turn the drone by hand, from when it is watched; None: nobody
            is asked, and the axes are not looked at.
    """
    clock = SystemClock()
    checks = [*of_files(config), of_wall_clock()]
    checks.append(await of_camera(config, clock))
    async with _linked(config, clock) as link:
        more, wrong = await of_autopilot(config, link)
        if tilt is not None and link.has_been_heard:
            more += await _of_axes(config, link, clock, tilt)
    return Outcome((*checks, *more), tuple(wrong))


async def set_parameters(
    config: Config,
    values: Mapping[str, float],
    keep: Callable[[Mapping[str, float]], None],
) -> list[str]:
    """Set parameters of the autopilot.

    Args:
        config: of the daemon.
        values: what they shall be.
        keep: given what they were, before the first is set; what it raises leaves them so.

    Returns:
        The names of those that did not take their value.

    Raises:
        ConfigError: no autopilot is heard.
    """
    async with _linked(config, SystemClock()) as link:
        if not await link.heard(_HEARTBEAT_S):
            raise ConfigError(
                f"no heartbeat of an autopilot over {config.autopilot.link}: nothing is changed"
            )
        asked = {name: await link.parameter(name) for name in values}
        before = {name: was for name, was in asked.items() if was is not None}
        if before:
            keep(before)
        failed = [name for name in values if name not in before]
        for name in before:
            value = values[name]
            now = await link.set_parameter(name, value)
            if now is None or abs(now - value) > 1e-5 * max(1.0, abs(value)):
                failed.append(name)
    return failed


def outcome_json(outcome: Outcome) -> str:
    """Return it for programs."""
    return json.dumps(
        {
            "good": outcome.is_good,
            "checks": [asdict(check) for check in outcome.checks],
            "parameters": [asdict(finding) for finding in outcome.wrong],
        },
        indent=1,
    )


@asynccontextmanager
async def _linked(config: Config, clock: Clock) -> AsyncIterator[AutopilotLink]:
    """Run a link to the autopilot for as long as it is needed."""
    link = AutopilotLink(config.autopilot, config.system_id, clock)
    running = asyncio.ensure_future(link.run())
    try:
        yield link
    finally:
        running.cancel()
        with suppress(asyncio.CancelledError, VclError):
            await running


async def _of_axes(
    config: Config, link: AutopilotLink, clock: Clock, tilt: Callable[[], None]
) -> list[Check]:
    """Have the drone turned by hand, and judge what is seen and said of that."""
    try:
        sensor = read_calibration(config.camera)
        camera = open_camera(config.camera, sensor, clock)
        try:
            tilt()
            motion = await watch_motion(camera, sensor.camera, link, clock, TILT_S)
        finally:
            await camera.close()
    except (VclError, OSError) as error:
        return [Check("axes", "failure", str(error), "is the camera free?")]
    return judge_axes(motion, sensor.body_from_cam.rotation)


async def of_autopilot(config: Config, link: AutopilotLink) -> tuple[list[Check], list[Finding]]:
    """Look at what the autopilot behind a running link says of itself."""
    if not await link.heard(_HEARTBEAT_S):
        advice = f"is it on, and autopilot.link right ({config.autopilot.link})? its system_id?"
        what = f"no heartbeat of system {config.system_id} in {_HEARTBEAT_S:.0f} s"
        return [Check("autopilot", "failure", what, advice)], []
    checks = [Check("autopilot", "ok", f"{link.firmware.value}, system {config.system_id}")]
    await asyncio.sleep(_STREAM_S)
    rate_hz, wanted_hz = link.attitudes.rate_hz, config.autopilot.attitude_rate_hz
    what = f"attitude comes at {rate_hz:.0f} of {wanted_hz:.0f} Hz"
    if rate_hz < _LEAST_ATTITUDE_SHARE * wanted_hz:
        checks.append(Check("link", "failure", what, "a faster baud rate, or fewer other streams"))
    else:
        checks.append(Check("link", "ok", what))
    checks.append(_of_time(link))
    rules = rules_for(
        link.firmware,
        sends_velocity=config.autopilot.message == "odometry",
        sets_origin=config.autopilot.origin is not None,
    )
    values: dict[str, float] = {}
    for n_asked, name in enumerate(names_of(rules)):
        if n_asked == _ALL_HAVE and not values:
            # Each question takes two seconds, and what is not said is not known to be lacking.
            what = "the autopilot answers no question for a parameter"
            advice = (
                "does the link carry what we send? does a router let PARAM_REQUEST_READ through?"
            )
            return [*checks, Check("parameters", "failure", what, advice)], []
        value = await link.parameter(name)
        if value is not None:
            values[name] = value
    wrong = findings(rules, values)
    for found in wrong:
        has = "is not there" if found.value is None else f"is {found.value:g}"
        checks.append(
            Check(
                found.name,
                _GRADE_OF[found.severity],
                f"{has}: {found.why}",
                f"set it to {found.should_be:g}",
            )
        )
    checks += of_frames(config.autopilot, link.firmware, values)
    if not wrong:
        checks.append(Check("parameters", "ok", f"all {len(values)} that matter are right"))
    return checks, wrong


def _of_time(link: AutopilotLink) -> Check:
    round_trip_s = link.attitudes.round_trip_s
    if round_trip_s is None:
        advice = "TIMESYNC: attitudes are timed by arrival, and a PX4 does not fuse"
        grade: Grade = "failure" if link.firmware is Firmware.PX4 else "warning"
        return Check("time", grade, "questions for the time are not answered", advice)
    what = f"answered in {round_trip_s * 1e3:.1f} ms"
    if round_trip_s > _ROUND_TRIP_S:
        return Check("time", "warning", what, "a slow link: instants are wrong by half of it")
    return Check("time", "ok", what)
