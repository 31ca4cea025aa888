"""The link to the vehicle's own autopilot: attitude in, pose out, clocks, state, texts."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from vcl_companion.clock import Clock
from vcl_companion.geometry.rotation import Array, euler_from_matrix, quaternion_from_matrix
from vcl_companion.links.attitude import Attitude, AttitudeHistory
from vcl_companion.links.autopilot_options import AutopilotOptions, ServiceState
from vcl_companion.links.counters import LinkCounters, LinkTally
from vcl_companion.links.fusion import Fusion, FusionMonitor
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    ATTITUDE_QUATERNION_ID,
    COMPONENT_AUTOPILOT,
    COMPONENT_COMPANION,
    EKF_STATUS_REPORT_ID,
    ESTIMATOR_STATUS_ID,
    FRAME_LOCAL_FRD,
    FRAME_LOCAL_NED,
    GLOBAL_ORIGIN_ID,
    LOCAL_POSITION_ID,
    ODOMETRY_ID,
    RESULT_ACCEPTED,
    SET_GLOBAL_ORIGIN,
    SET_MESSAGE_INTERVAL,
    VISION_POSITION_ESTIMATE_ID,
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
from vcl_companion.links.reconnect import Address
from vcl_companion.links.stream_requests import StreamRequests
from vcl_companion.links.texts import Severity, Texts
from vcl_companion.links.timesync import TimesyncEstimator
from vcl_companion.links.transport import open_transport
from vcl_companion.links.vehicle_mode import VehicleMode, mode_of
from vcl_companion.links.vision_pose import Firmware, PoseEstimate, covariance_for, firmware_of

_log = logging.getLogger(__name__)

_HEARTBEAT_S = 1.0
# Questions come quickly until the estimate has enough to choose from.
_SYNC_FAST_S, _SYNC_SLOW_S = 0.1, 1.0
_SYNC_ENOUGH = 8
# After this many unanswered questions (1 s) the autopilot does without TIMESYNC.
_SYNC_GIVEN_UP = 10
# How far back estimators fuse: EKF2_DELAY_MAX; VISO_DELAY_MS goes up to 0.25.
_REMEMBERS_S = 0.2
# Poses were sent for as long as the last one is no older; how often, the last ten say.
_POSES_LAST_S, _POSES_COUNTED = 1.0, 10
# 0 is what an autopilot that has heard of none takes for known.
_RESETS = 255
_FIRMWARE = {"ardupilot": Firmware.ARDUPILOT, "px4": Firmware.PX4}


class AutopilotLink:
    """Our side of the link to one autopilot; everything happens in the event loop's thread."""

    def __init__(self, options: AutopilotOptions, system_id: int, clock: Clock) -> None:
        self._options = options
        self._system_id = system_id
        self._clock = clock
        self._tally = LinkTally()
        self._codec = Codec(system_id, COMPONENT_COMPANION, self._tally)
        self._transport = open_transport(
            options.link, self._tally, allowed_senders=options.allowed_senders
        )
        latency_ns = round(options.attitude_latency_s * 1e9)
        max_age_ns = round(options.max_attitude_age_s * 1e9)
        self._by_quaternion = AttitudeHistory(latency_ns, max_age_ns)
        self._by_euler = AttitudeHistory(latency_ns, max_age_ns)
        self._streams = StreamRequests(options.attitude_rate_hz, self._request_stream)
        self._texts = Texts(self._codec, self._transport)
        self.is_paused = False
        """Whether poses are held back, as the ground has commanded."""
        self.on_command: Callable[[CommandLong], None] | None = None
        self.on_parameter: Callable[[ParameterOrder], None] | None = None
        """Shown who asks for a parameter of ours, or sets one; only ground systems may set."""
        self._sent_at_s: deque[float] = deque(maxlen=_POSES_COUNTED)
        self._parameters = Parameters(self._read_parameter, self._write_parameter)
        self._fusion = FusionMonitor()
        self._sync = TimesyncEstimator()
        self._asked_at_s = -math.inf
        self._news = asyncio.Event()
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
        self._firmware = _FIRMWARE.get(options.profile, Firmware.OTHER)
        for told in (self._streams, self._fusion, self.origin):
            told.firmware = self._firmware
        self._first_reset: int | None = None
        self._mode = VehicleMode()

    @property
    def options(self) -> AutopilotOptions:
        """How the autopilot is told; ``max_pose_age_s`` and ``time_error_s`` may be changed."""
        return self._options

    @options.setter
    def options(self, options: AutopilotOptions) -> None:
        self._options = options

    @property
    def pose_message_id(self) -> int:
        """In which message poses are sent."""
        by_vision = self._options.message == "vision_position_estimate"
        return VISION_POSITION_ESTIMATE_ID if by_vision else ODOMETRY_ID

    @property
    def pose_interval_s(self) -> float | None:
        """From one pose that was sent to the next, s; None when none goes out now."""
        now_s = asyncio.get_running_loop().time()
        sent = self._sent_at_s
        if len(sent) < 2 or now_s - sent[-1] > _POSES_LAST_S:
            return None
        return (sent[-1] - sent[0]) / (len(sent) - 1)

    @property
    def counters(self) -> LinkCounters:
        """What went over the link so far."""
        return self._tally.snapshot()

    @property
    def round_trip_s(self) -> float | None:
        """Shortest recent TIMESYNC round trip, s; None without one."""
        return self._sync.round_trip_s

    async def run(self) -> None:
        """Keep the link alive until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._transport.run(self._receive, self._greet))
            group.create_task(self._heartbeats())
            group.create_task(self._questions())
            group.create_task(self._streams.run())
            group.create_task(self.origin.run())

    @property
    def firmware(self) -> Firmware:
        """Whose software the autopilot runs, as far as is known."""
        return self._firmware

    @property
    def attitude_rate_hz(self) -> float:
        """How often ATTITUDE_QUATERNION came in the last seconds, Hz."""
        return self._by_quaternion.rate_hz

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

    async def attitude_at(self, at_ns: int, wait_s: float) -> Attitude | None:
        """Return the attitude at an instant of our clock.

        Waits until a sample at or after the instant has come, ``wait_s`` at most,
        then takes what there is: None when nothing lies within the option
        ``max_attitude_age_s``, or while it is not known yet whose time is whose.
        """
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + wait_s
        while True:
            offset_ns = self._offset_ns(at_ns)
            if offset_ns is not None and self._history(at_ns, offset_ns).covers(at_ns, offset_ns):
                break
            if offset_ns is None:
                self._ask_if_due(_SYNC_FAST_S)
            remaining_s = deadline_s - loop.time()
            if remaining_s <= 0.0:
                break
            try:
                async with asyncio.timeout(remaining_s):
                    await self._news.wait()
            except TimeoutError:
                break
        # A good moment to ask: in a replay the clocks of all processes stand together now.
        self._ask_if_due(_SYNC_SLOW_S)
        return self.known_attitude(at_ns)

    def known_attitude(self, at_ns: int) -> Attitude | None:
        """Return the attitude at an instant of our clock by what has come; see ``attitude_at``."""
        offset_ns = self._offset_ns(at_ns)
        if offset_ns is None:
            return None
        return self._history(at_ns, offset_ns).at(at_ns, offset_ns)

    async def news(self) -> None:
        """Wait until the autopilot says how it is turned, or what time it is."""
        await self._news.wait()

    def newest_attitude_ns(self) -> int | None:
        """Return the instant of the newest attitude, our clock; None while it is not known."""
        now_ns = self._clock.now_ns()
        offset_ns = self._offset_ns(now_ns)
        return None if offset_ns is None else self._history(now_ns, offset_ns).newest_ns(offset_ns)

    def send_pose(self, estimate: PoseEstimate, *, is_of_frame: bool = True) -> str | None:
        """Send where we were, as the autopilot's firmware wants to be told.

        Args:
            estimate: where.
            is_of_frame: whether a frame gave it; what lies between tells nothing of whether the
                autopilot follows us.

        Returns:
            None when it was sent; else why not: the ground has paused it, it is too old, or the
            covariance is not finite or has a negative variance.
        """
        if self.is_paused:
            return "paused by the ground"
        age_s = (self._clock.now_ns() - estimate.at_ns) * 1e-9
        if age_s > self._options.max_pose_age_s:
            self._tally.refuse("pose not sent: too old")
            return f"its pose was {age_s:.1f} s old"
        # It takes what is older than it remembers for the oldest that it does.
        time_error_s = math.hypot(self._options.time_error_s, max(0.0, age_s - _REMEMBERS_S))
        covariance = covariance_for(self._firmware, estimate, time_error_s)
        if isinstance(covariance, str):
            self._tally.refuse(f"pose not sent: {covariance}")
            return f"the pose's covariance is not one: {covariance}"
        pose = estimate.local_from_body
        x_m, y_m, z_m = pose.translation.tolist()
        usec, reset_counter = estimate.at_ns // 1000, self._reset_counter(estimate.n_resets)
        if self._options.message == "vision_position_estimate":
            angles = euler_from_matrix(pose.rotation)
            frame = self._codec.vision_position_estimate(
                usec, (x_m, y_m, z_m), angles, covariance, reset_counter
            )
        else:
            turn = pose.rotation.T
            # ArduPilot drops what is not FRD; PX4 takes FRD for turned, and NED as it is.
            is_px4 = self._firmware is Firmware.PX4
            frame = self._codec.odometry(
                usec,
                FRAME_LOCAL_NED if is_px4 else FRAME_LOCAL_FRD,
                (x_m, y_m, z_m),
                tuple(quaternion_from_matrix(pose.rotation).tolist()),
                tuple((turn @ estimate.velocity_local_m_s).tolist()),
                covariance,
                turn @ estimate.velocity_covariance @ turn.T,
                reset_counter,
            )
        self._transport.write(frame)
        self._sent_at_s.append(asyncio.get_running_loop().time())
        if not is_of_frame:
            self._fusion.sent_between(estimate.at_ns)
            return None
        sigma_m = math.sqrt(max(float(np.linalg.eigvalsh(covariance[:3, :3])[-1]), 0.0))
        self._fusion.sent(estimate.at_ns, pose.translation, sigma_m, estimate.n_resets)
        return None

    def _reset_counter(self, n_resets: int) -> int:
        """Return a counter that is not the autopilot's own first one, nor our last run's.

        An ArduPilot that has heard of no reset begins at its origin. Its first pose then, 2.7 m
        from there, is a step to it, and not a beginning: it believed to fly at 75 m/s.
        """
        if self._first_reset is None:
            self._first_reset = self._clock.now_ns() // 1_000_000_000
        return 1 + (self._first_reset + n_resets) % _RESETS

    def set_state(self, state: ServiceState) -> None:
        """Say from the next heartbeat on how we are."""
        self._state = state

    def say(self, severity: Severity, text: str) -> None:
        """Send STATUSTEXT, unless it was the last one said; said again when a link comes back."""
        self._texts.say(severity, text)

    def announce(self, severity: Severity, text: str) -> None:
        """Send STATUSTEXT of something that has happened: once, whatever the link does."""
        self._texts.announce(severity, text)

    def _history(self, at_ns: int, offset_ns: int) -> AttitudeHistory:
        if self._by_quaternion.is_near(at_ns, offset_ns):
            return self._by_quaternion
        return self._by_euler

    def _offset_ns(self, at_ns: int) -> int | None:
        """Return our clock minus the autopilot's; None while its answer may still come."""
        offset_ns = self._sync.offset_ns(at_ns)
        if offset_ns is None and self._sync.unanswered >= _SYNC_GIVEN_UP:
            offset_ns = self._by_quaternion.offset_by_arrival_ns()
            if offset_ns is None:
                offset_ns = self._by_euler.offset_by_arrival_ns()
        return offset_ns

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
                refusal = self._sync.answered(ts1_ns, tc1_ns, self._clock.now_ns())
                if refusal is not None:
                    self._tally.refuse(refusal)
                self._wake()
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
                self._mode = mode_of(message)
                self.origin.is_armed = self._mode.is_armed
                if self._options.profile == "auto":
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
        elif message.sender_system not in (*self._options.ground_systems, self._system_id):
            self._tally.refuse("a command of a stranger")
        elif self.on_command is not None:
            self.on_command(message)

    def _take_parameter_order(self, message: ParameterOrder) -> None:
        """Hand on who asks for our parameters; anybody aboard may look, the ground may set."""
        may = self._options.ground_systems
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
        offset_ns = self._offset_ns(self._clock.now_ns())
        if offset_ns is not None:
            measured_ns = message.time_boot_ms * 1_000_000 + offset_ns
            self._fusion.believes(measured_ns, message.position, message.velocity)

    def _is_of(self, firmware: Firmware) -> None:
        if firmware is not self._firmware:
            self._firmware = firmware
            _log.info("the autopilot's firmware: %s", firmware.value)
            for told in (self._streams, self._fusion, self.origin):
                told.firmware = firmware
            self._streams.ask_for_all()

    def _take_attitude(self, sample: AttitudeSample) -> None:
        quaternion = sample.source == "quaternion"
        if quaternion:
            self._streams.heard(ATTITUDE_QUATERNION_ID)
        history = self._by_quaternion if quaternion else self._by_euler
        match history.add(sample, self._clock.now_ns()):
            case "overtaken":
                self._tally.refuse("attitude overtaken by a later one")
            case "turned":
                degrees = math.degrees(history.north_rad)
                if self._first_reset is None:
                    history.take_its_north()
                    _log.info("the autopilot has found its north, by %.1f degrees", degrees)
                else:
                    _log.info("the autopilot has turned its north, by %.1f degrees so far", degrees)
            case "rebooted":
                _log.warning("the autopilot has restarted")
                self._sync.reset()
                self._fusion = FusionMonitor()
                self._streams.ask_for_all()
                self.origin.forget()
                (self._by_euler if quaternion else self._by_quaternion).clear()
        self._wake()

    def _wake(self) -> None:
        self._news.set()
        self._news.clear()

    def _greet(self) -> None:
        """Make ourselves known on a link that has just come up."""
        self.send_heartbeat()
        if self._clock.now_ns() > 0:
            self._ask_if_due(0.0)
        self._streams.ask_for_all()
        self._texts.say_again()

    async def _heartbeats(self) -> None:
        while True:
            await asyncio.sleep(_HEARTBEAT_S)
            self.send_heartbeat()

    async def _questions(self) -> None:
        while True:
            await asyncio.sleep(_SYNC_FAST_S)
            settled = self._sync.n_exchanges >= _SYNC_ENOUGH
            hopeless = self._sync.unanswered >= _SYNC_GIVEN_UP
            # A clock that has not been told the time yet has nothing to compare.
            if self._clock.now_ns() > 0:
                self._ask_if_due(_SYNC_SLOW_S if settled or hopeless else _SYNC_FAST_S)

    def _ask_if_due(self, every_s: float) -> None:
        now_s = asyncio.get_running_loop().time()
        if now_s - self._asked_at_s < every_s:
            return
        self._asked_at_s = now_s
        self._transport.write(self._codec.timesync(0, self._sync.ask(self._clock.now_ns())))

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
