"""The link to the vehicle's own autopilot: attitude in, pose out, clocks, state, texts."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from vcl_companion.clock import Clock
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot_options import AutopilotOptions, ServiceState
from vcl_companion.links.counters import LinkCounters, LinkTally
from vcl_companion.links.fusion import Fusion, FusionMonitor
from vcl_companion.links.heading_source import HeadingSource
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    ATTITUDE_QUATERNION_ID,
    COMPONENT_AUTOPILOT,
    COMPONENT_COMPANION,
    EKF_STATUS_REPORT_ID,
    ESTIMATOR_STATUS_ID,
    GLOBAL_ORIGIN_ID,
    LOCAL_POSITION_ID,
    RESULT_ACCEPTED,
    SET_GLOBAL_ORIGIN,
    SET_MESSAGE_INTERVAL,
    AttitudeSample,
    CommandAck,
    CommandLong,
    EstimatorStatus,
    GlobalOrigin,
    Heartbeat,
    LocalPosition,
    Message,
    ParameterOrder,
    ParameterSet,
    ParameterValue,
    Timesync,
)
from vcl_companion.links.origin import GlobalPlace, OriginSetter
from vcl_companion.links.parameters import Parameters
from vcl_companion.links.pose_sender import PoseSender
from vcl_companion.links.reconnect import Address
from vcl_companion.links.stream_requests import StreamRequests
from vcl_companion.links.texts import Severity, Texts
from vcl_companion.links.timed_attitude import TimedAttitude
from vcl_companion.links.transport import open_transport
from vcl_companion.links.vehicle_mode import VehicleMode, mode_of
from vcl_companion.links.vision_pose import Firmware, firmware_of

_log = logging.getLogger(__name__)

_HEARTBEAT_S = 1.0
# So often it is looked whether a first one of the autopilot's has come.
_LOOK_S = 0.02
# Whole heartbeats of ours in which an autopilot's would have come.
_SILENT_S = 10.0
_FIRMWARE = {"ardupilot": Firmware.ARDUPILOT, "px4": Firmware.PX4}


class AutopilotLink:
    """Our side of the link to one autopilot; everything happens in the event loop's thread."""

    def __init__(self, options: AutopilotOptions, system_id: int, clock: Clock) -> None:
        self._system_id = system_id
        self._clock = clock
        self._tally = LinkTally()
        self._codec = Codec(system_id, COMPONENT_COMPANION, self._tally)
        self._transport = open_transport(
            options.link, self._tally, allowed_senders=options.allowed_senders
        )
        self._streams = StreamRequests(options.attitude_rate_hz, self._request_stream)
        self._texts = Texts(self._codec, self._transport)
        self.on_command: Callable[[CommandLong], None] | None = None
        self.on_parameter: Callable[[ParameterOrder], None] | None = None
        """Shown who asks for a parameter of ours, or sets one; only ground systems may set."""
        self._parameters = Parameters(self._read_parameter, self._write_parameter)
        self._fusion = FusionMonitor()
        self.poses = PoseSender(
            options, self._codec, self._transport.write, clock, self._tally, self._fusion
        )
        """Tells it where it is."""
        self.attitudes = TimedAttitude(
            options,
            clock,
            self._ask_for_time,
            is_told=lambda: self.poses.has_sent,
            has_own_north=lambda: self._heading.was_own,
        )
        """What it says of how it is turned, by our clock."""
        self._state = ServiceState.STARTING
        self.origin = OriginSetter(
            None if options.origin is None else GlobalPlace(*options.origin),
            self.parameter,
            partial(self._request, GLOBAL_ORIGIN_ID),
            partial(self._set_origin, self._codec.command_global_origin),
            partial(self._set_origin, self._codec.set_global_origin),
            self.announce,
        )
        """Sets the origin of the autopilot's local frame."""
        self._heading = HeadingSource(self.parameter)
        self._firmware = _FIRMWARE.get(options.profile, Firmware.OTHER)
        if options.profile != "auto":
            self._heading.is_of(self._firmware)
        self._told_firmware = (self._streams, self._fusion, self.origin, self.poses)
        for told in self._told_firmware:
            told.firmware = self._firmware
        self._mode = VehicleMode()
        self.has_been_heard = False
        """Whether any heartbeat of it has come."""
        self._silent_s = 0.0

    @property
    def options(self) -> AutopilotOptions:
        """How the autopilot is told; ``max_pose_age_s`` and ``time_error_s`` may be changed."""
        return self.poses.options

    @options.setter
    def options(self, options: AutopilotOptions) -> None:
        self.poses.options = options

    @property
    def counters(self) -> LinkCounters:
        """What went over the link so far."""
        return self._tally.snapshot()

    async def run(self) -> None:
        """Keep the link alive until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._transport.run(self._receive, self._greet))
            group.create_task(self._heartbeats())
            group.create_task(self.attitudes.run())
            group.create_task(self._streams.run())
            group.create_task(self.origin.run())
            group.create_task(self._heading.run())

    @property
    def firmware(self) -> Firmware:
        """Whose software the autopilot runs, as far as is known."""
        return self._firmware

    @property
    def has_heading(self) -> bool:
        """Whether the heading of its attitudes is its own, a compass's, and not what we tell it."""
        return self._heading.is_own

    def answer(self, message: CommandLong, result: int, progress: int = 255) -> None:
        """Say what became of a command, to who gave it: MAV_RESULT, and percent of its way."""
        self._transport.write(
            self._codec.command_ack(
                message.command, result, progress, message.sender_system, message.sender_component
            )
        )

    def send(self, message: Any) -> None:
        """Send one of ``own_messages``."""
        self._transport.write(self._codec.frame(message))

    async def heard(self, within_s: float) -> bool:
        """Wait for a first heartbeat of it; return whether one has come by then."""
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while not self.has_been_heard:
                    await asyncio.sleep(_LOOK_S)
        return self.has_been_heard

    @property
    def is_heard(self) -> bool:
        """Whether it has sent a heartbeat lately, or we have not listened for long yet."""
        return self._silent_s < _SILENT_S

    @property
    def is_silent(self) -> bool:
        """Whether we have no heartbeat."""
        return self._state is ServiceState.STALLED

    def send_heartbeat(self) -> None:
        """Send a HEARTBEAT at once, unless we have none."""
        if not self.is_silent:
            self._transport.write(self._codec.heartbeat(self._state.value))

    async def parameter(self, name: str) -> float | None:
        """Return one of the autopilot's parameters; None when it has none of the name."""
        return await self._parameters.value(name, self._firmware)

    async def set_parameter(self, name: str, value: float) -> float | None:
        """Set one of the autopilot's parameters; return what it is then, None if it is not said."""
        return await self._parameters.set(name, value, self._firmware)

    def fusion(self) -> Fusion:
        """Return what becomes of our poses, by what the autopilot says of itself."""
        return self._fusion.state(self._clock.now_ns())

    def expected_at(self, at_ns: int) -> Array | None:
        """Return (3,) where the autopilot takes the drone to be, local NED, m; None: unknown."""
        return self._fusion.expected_at(at_ns)

    @property
    def mode(self) -> VehicleMode:
        """How the vehicle is flown, by its last HEARTBEAT."""
        return self._mode

    @property
    def ahead_s(self) -> float | None:
        """By how much the autopilot takes our poses for older than they are, s; None: unknown."""
        return self._fusion.ahead_s

    def set_state(self, state: ServiceState) -> None:
        """Say from the next heartbeat on how we are."""
        self._state = state

    def say(self, severity: Severity, text: str) -> None:
        """Send STATUSTEXT, unless it was the last one said; said again when a link comes back."""
        self._texts.say(severity, text)

    def announce(self, severity: Severity, text: str) -> None:
        """Send STATUSTEXT of something that has happened: once, whatever the link does."""
        self._texts.announce(severity, text)

    def _receive(self, data: bytes, _: Address | None) -> bool:
        accepted = False
        for message in self._codec.decode(data, is_stream=self._transport.is_stream):
            if isinstance(message, CommandLong):
                self._take_command(message)
            elif isinstance(message, ParameterOrder):
                self._take_parameter_order(message)
            elif message.sender_system != self._system_id:
                self._tally.refuse("another system")
            elif message.sender_component != COMPONENT_AUTOPILOT:
                self._tally.refuse("another component")
            else:
                accepted = True
                self._accept(message)
        return accepted

    def _accept(self, message: Message) -> None:
        match message:
            case Timesync(tc1_ns=0, ts1_ns=ts1_ns):
                # Never 0: that would make a question of the answer.
                now_ns = max(1, self._clock.now_ns())
                self._transport.write(self._codec.timesync(now_ns, ts1_ns))
            case Timesync(tc1_ns=tc1_ns, ts1_ns=ts1_ns):
                refusal = self.attitudes.answered(ts1_ns, tc1_ns)
                if refusal is not None:
                    self._tally.refuse(refusal)
            case AttitudeSample():
                self._take_attitude(message)
            case ParameterValue():
                self._parameters.answered(message)
            case EstimatorStatus():
                for message_id in (EKF_STATUS_REPORT_ID, ESTIMATOR_STATUS_ID):
                    self._streams.heard(message_id)
                self._fusion.reported(message, self._clock.now_ns())
            case LocalPosition():
                self._streams.heard(LOCAL_POSITION_ID)
                self._take_position(message)
            case GlobalOrigin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude):
                self.origin.said(GlobalPlace(latitude, longitude, altitude))
            case Heartbeat():
                self.has_been_heard = True
                if self._silent_s >= _SILENT_S:
                    _log.info("the autopilot is heard")
                self._silent_s = 0.0
                self._mode = mode_of(message)
                self.origin.is_armed = self._mode.is_armed
                if self.options.profile == "auto":
                    self._is_of(firmware_of(message.autopilot))
            case CommandAck(command=command, result=result, target_system=target):
                for_us = target in (0, self._system_id)
                if for_us and command == SET_GLOBAL_ORIGIN:
                    self.origin.answered(result)
                elif for_us and command == SET_MESSAGE_INTERVAL and result != RESULT_ACCEPTED:
                    _log.warning("the autopilot refuses to stream attitude (result %d)", result)

    def _take_command(self, message: CommandLong) -> None:
        """Hand a command on that is for us, from who may give it."""
        is_for_us = message.target_system == self._system_id
        if not is_for_us or message.target_component not in (0, COMPONENT_COMPANION):
            self._tally.refuse("a command for somebody else")
        elif message.sender_system not in (*self.options.ground_systems, self._system_id):
            self._tally.refuse("a command of a stranger")
        elif self.on_command is not None:
            self.on_command(message)

    def _take_parameter_order(self, message: ParameterOrder) -> None:
        """Hand on who asks for our parameters; anybody aboard may look, the ground may set."""
        may = self.options.ground_systems
        if not isinstance(message, ParameterSet):
            may = (*may, self._system_id)
        for_us = message.target_system in (0, self._system_id)
        if not for_us or message.target_component not in (0, COMPONENT_COMPANION):
            self._tally.refuse("a parameter of somebody else")
        elif message.sender_system not in may:
            self._tally.refuse("a parameter for a stranger")
        elif self.on_parameter is not None:
            self.on_parameter(message)

    def _take_position(self, message: LocalPosition) -> None:
        self.origin.height_m = -float(message.position[2])
        measured_ns = self.attitudes.instant_ns(message.time_boot_ms)
        if measured_ns is not None:
            self._fusion.believes(measured_ns, message.position, message.velocity)

    def _is_of(self, firmware: Firmware) -> None:
        self._heading.is_of(firmware)
        if firmware is not self._firmware:
            self._firmware = firmware
            _log.info("the autopilot's firmware: %s", firmware.value)
            for told in self._told_firmware:
                told.firmware = firmware
            self._streams.ask_for_all()

    def _take_attitude(self, sample: AttitudeSample) -> None:
        if sample.source == "quaternion":
            self._streams.heard(ATTITUDE_QUATERNION_ID)
        match self.attitudes.take(sample):
            case "overtaken":
                self._tally.refuse("attitude overtaken by a later one")
            case "rebooted":
                _log.warning("the autopilot has restarted")
                self._fusion.forget()
                self._streams.ask_for_all()
                self.origin.forget()
                self._heading.forget()

    def _greet(self) -> None:
        """Make ourselves known on a link that has just come up."""
        self.send_heartbeat()
        self.attitudes.ask_now()
        self._streams.ask_for_all()
        self._texts.say_again()

    async def _heartbeats(self) -> None:
        while True:
            await asyncio.sleep(_HEARTBEAT_S)
            self.send_heartbeat()
            self._silent_s += _HEARTBEAT_S
            if self._silent_s == _SILENT_S:
                _log.warning(
                    "no heartbeat of an autopilot of system %d in %.0f s over %s: is it on, and "
                    "are autopilot.link and system_id right?",
                    self._system_id,
                    _SILENT_S,
                    self.options.link,
                )

    def _ask_for_time(self, now_ns: int) -> None:
        self._transport.write(self._codec.timesync(0, now_ns))

    def _request_stream(self, message_id: int, interval_us: int) -> None:
        self._transport.write(
            self._codec.set_message_interval(self._system_id, message_id, interval_us)
        )

    def _request(self, message_id: int) -> None:
        self._transport.write(self._codec.request_message(self._system_id, message_id))

    def _set_origin(
        self, encode: Callable[[int, float, float, float], bytes], place: GlobalPlace
    ) -> None:
        at = (place.latitude_deg, place.longitude_deg, place.altitude_m)
        self._transport.write(encode(self._system_id, *at))

    def _read_parameter(self, name: str) -> None:
        self._transport.write(self._codec.read_parameter(self._system_id, name))

    def _write_parameter(self, name: str, raw: bytes, kind: int) -> None:
        self._transport.write(self._codec.set_parameter(self._system_id, name, raw, kind))
