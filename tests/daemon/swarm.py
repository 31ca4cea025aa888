"""Drones that share maps, in one process: real exchanges, links and autopilot links on loopback."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sitl.frame_server import FrameServer
from tests.daemon import demo
from tests.daemon.autopilot import Autopilot, autopilot_and_link
from tests.daemon.waiting import beside, until
from tests.ports import free_ports
from tests.whole_lines import json_lines
from vcl_companion.cameras.source import Frame
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.catching_up import CatchingUp
from vcl_companion.daemon.commands import Commands
from vcl_companion.daemon.companion import Companion
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.exchange import Exchange, ExchangeOptions
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.map_in_flight import MapInFlight
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.message_requests import MessageRequests
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.onboard_computer import OnboardComputer
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.daemon.peer_poses import PeerPoses
from vcl_companion.daemon.saved_map import SavedMap
from vcl_companion.daemon.settings import open_settings
from vcl_companion.daemon.teller import Teller
from vcl_companion.daemon.worker import Worker
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions, Heading
from vcl_companion.links.counters import LinkCounters
from vcl_companion.links.key_file import make_key_file
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerLink, PeerOptions, open_signing
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.transfer import (
    BlobKind,
    BlobReceived,
    Event,
    TransferOptions,
    Transfers,
)
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame
from vcl_companion.wire.map_update import name_of_image
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import PoseProposal, PoseRefused
from vcl_companion.wire.tunnel import PayloadType, decode_payload, encode_payload

Message = FrameRequest | MapState | MapRefused | PoseProposal | PoseRefused
_Kind = TypeVar("_Kind", bound="Drone")

MESSAGE, DATA = PayloadType.MESSAGE, PayloadType.TRANSFER_DATA
COMPANION = 197
INTER = InterMavOptions(detector="akaze")
NO_UPDATES = UpdateOptions(tracked=0, share=0.0)
FAST = TransferOptions(rate_bytes_per_s=5e6, status_interval_s=0.05)


class Drone:
    """All of a daemon that deals with peers, and what it says into its log."""

    def __init__(
        self,
        system_id: int,
        members: tuple[int, ...],
        peers: PeerOptions,
        autopilot: tuple[Autopilot, AutopilotLink],
        clock: ManualClock,
        executor: Worker,
        log_path: Path,
        transfer: TransferOptions,
        inter: InterMavOptions,
        update: UpdateOptions,
        seed: int,
        directory: str = "",
        north_deg: float = 0.0,
        heading: Heading = "map",
    ) -> None:
        self.system_id = system_id
        self._north = Pose(exp_so3(np.deg2rad([0.0, 0.0, north_deg])), np.zeros(3))
        self.autopilot, self.autopilot_link = autopilot
        self.clock = clock
        self._log_path = log_path
        self.log = FlightLog(str(log_path), clock)
        self.maps = MapStore(directory)
        self.requests: list[FrameRequest] = []
        self._last_seen = 0
        self.estimator = Estimator(
            FilterOptions(), LocalizationOptions(), lambda why: self.log.event("jump", why),
            heading=heading,
        )  # fmt: skip
        swarm = SwarmOptions(members, demo.LEADER, demo.known_distances(1, 2))
        rng = np.random.default_rng(seed)
        self.group = Group(swarm, system_id)
        self.work = MapWork(demo.workshop(swarm, demo.sensor(system_id), inter), forks=False)
        self.exchange = Exchange(
            system_id, self.group, Transfers(transfer, rng), self.maps,
            self.autopilot_link, demo.sensor(system_id), clock, self.log, self.work,
            executor, self.estimator,
            ExchangeOptions(swarm, demo.MAP_OPTIONS, update, ("akaze",), inter, tracked=False),
            rng,
        )  # fmt: skip
        self._link = PeerLink(
            peers, system_id, frozenset(members), self._hear, self.exchange.on_heartbeat,
            clock, self.exchange.clocks.answered, open_signing(peers),
        )  # fmt: skip
        self.exchange.attach(self._link)
        frames_alone = AutopilotOptions(min_rate_hz=0.0)
        self.teller = Teller(self.autopilot_link, self.estimator, clock, self.log, frames_alone)
        self.in_flight = MapInFlight(self.maps, executor)
        self.saved = SavedMap(
            self.maps, self.in_flight, self.exchange.go_back_to, self.estimator, executor,
            self.autopilot_link, self.log,
        )  # fmt: skip
        self.computer = OnboardComputer(log_path.parent)
        self.messages = MessageRequests(self.autopilot_link, self.computer, executor)
        commands = Commands(
            self.autopilot_link, self.exchange, self.maps, self.estimator, self.teller, self.saved,
            self.messages, self.log,
        )  # fmt: skip
        self.parameters = open_settings(self.autopilot_link, self.exchange, commands, self.log)

    async def run(self) -> None:
        async with asyncio.TaskGroup() as parts:
            for part in (self.autopilot_link, self._link, self.messages, self.parameters):
                parts.create_task(part.run())
            await self.saved.begin()
            parts.create_task(self.in_flight.run())
            parts.create_task(self.exchange.run())

    def close(self) -> None:
        self.work.end()
        self.log.close()

    def _looked(self) -> None:
        """Have a frame been looked at on the map in use, as a companion would say."""
        self.estimator.in_sight.seen_on = self.revision

    def track(self, n_landmarks: int, at: Pose | None = None) -> None:
        """Have the drone look at a frame with so many landmarks in it, without one at 0.

        Where it was is by their patches then, if it is given, else where it took what it has seen.
        """
        at_ns = self.clock.now_ns()
        self._looked()
        predicted = self.estimator.predicted(at_ns, None)
        if n_landmarks == 0:
            self.estimator.take_nothing(predicted, at_ns, None)
            return
        there = demo.world_from_body(self.system_id, self._last_seen)
        fix = Localized(
            at or there, 1e-4 * np.eye(6), 1e-4 * np.eye(6), np.zeros((6, 0)),
            np.zeros((0, 0)), n_landmarks, n_landmarks, False, 0.5,
            n_seen=n_landmarks, covered=1.0, by="patches" if at else "features",
        )  # fmt: skip
        self.estimator.take_fix(predicted, fix, at_ns, None)

    async def see(self, frame: Frame) -> None:
        """Have the drone take a frame, when its autopilot has measured at that instant."""
        self._looked()
        self._last_seen = frame.sequence
        self.clock.advance_to(frame.captured_at_ns)
        taken = demo.shot(self.system_id).ned_from_body
        self.autopilot.measure(frame.captured_at_ns, taken.quaternion())
        assert await self.autopilot_link.attitudes.at(frame.captured_at_ns, 5.0) is not None
        self.exchange.on_frame(frame)

    @property
    def link_counters(self) -> LinkCounters:
        """What went to and from its peers so far."""
        return self._link.counters

    @property
    def revision(self) -> bytes:
        """Of the map it flies on; empty without one."""
        return b"" if self.maps.current is None else self.maps.current.revision

    @property
    def wants_update(self) -> bool:
        """Whether it has told that it votes for an update."""
        state = self.group.state_of(self.system_id)
        return state is not None and state.wants_update

    def lines(self, kind: str) -> list[dict[str, Any]]:
        """What its log says of one kind so far."""
        return [record for record in json_lines(self._log_path) if record["kind"] == kind]

    def events(self, event: str) -> list[str]:
        """The reasons of the events of one name so far."""
        return [line["reason"] for line in self.lines("event") if line["event"] == event]

    def _hear(self, tunnel: Tunnel) -> None:
        if tunnel.payload_type == MESSAGE and tunnel.payload[1:2] == b"\x03":
            with contextlib.suppress(Exception):
                message = decode_payload(tunnel.payload_type, tunnel.payload)
                assert isinstance(message, FrameRequest)
                self.requests.append(message)
        self.exchange.on_tunnel(tunnel)


class Flyer(Drone):
    """The same with everything from camera to autopilot, so that it sees what it sees."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self.camera = FrameServer(f"mav{self.system_id - 1}")

    async def run(self) -> None:
        sensor = demo.sensor(self.system_id)
        size_px = (sensor.camera.width_px, sensor.camera.height_px)
        port = await self.camera.start()
        source = StreamCamera("127.0.0.1", port, size_px, self.clock)
        source.is_busy = self.exchange.is_busy
        with ThreadPoolExecutor(1) as executor:
            health = Health(self.autopilot_link, self.log)
            own_fixes = OwnFixes(
                sensor, self.autopilot_link, self.maps, self.estimator, self.log, executor,
                PipelineOptions(demo.FEATURES, LocalizationOptions(), TrackingOptions()),
                Odometry(sensor, self.system_id, self.work),
            )  # fmt: skip
            companion = Companion(
                source, FrameOutcomes(source, self.clock, health, self.log), own_fixes,
                CatchingUp(
                    self.system_id, self.exchange.frames, self.maps, self.estimator, own_fixes,
                ),
                PeerPoses(self.exchange.inter, self.maps, self.estimator, self.log), self.teller,
                self.maps, self.estimator, self.exchange.on_frame, health, self.work,
                frame_wait_s=0.1,
            )  # fmt: skip
            try:
                async with asyncio.TaskGroup() as parts:
                    parts.create_task(super().run())
                    parts.create_task(companion.read_camera())
                    parts.create_task(companion.run())
            finally:
                await source.close()
                await self.camera.close()

    async def give(self, k: int) -> None:
        """Hand out the k-th picture, its attitude first; do not wait for its answer."""
        await self.camera.connected()
        shot = demo.shot(self.system_id, k)
        self.autopilot.measure(shot.at_ns, (self._north @ shot.ned_from_body).quaternion())
        self.camera.give(self.camera.n_given, shot.at_ns, demo.png(shot.image))

    async def fly(self, k: int) -> None:
        """Hand out the k-th picture and wait until it is answered."""
        await self.give(k)
        await self.camera.answered()


class Stranger:
    """A member of the swarm that says what a test wants it to.

    It keeps its time to itself until its ``clock`` is told one.
    """

    def __init__(self, system_id: int, members: tuple[int, ...], peers: PeerOptions) -> None:
        self.system_id = system_id
        self.clock = ManualClock()
        self._link = PeerLink(
            peers, system_id, frozenset(members), self._hear, lambda _: None,
            self.clock, lambda *_: None, open_signing(peers),
        )  # fmt: skip
        self.forget()
        self.messages: asyncio.Queue[Message] = asyncio.Queue()
        self.blobs: asyncio.Queue[BlobReceived] = asyncio.Queue()
        self._heard: set[int] = set()

    def forget(self) -> None:
        """Remember no transfer, like one that has just been started."""
        self._transfers = Transfers(FAST, np.random.default_rng(0))

    async def run(self) -> None:
        async with asyncio.TaskGroup() as parts:
            parts.create_task(self._link.run())
            parts.create_task(self._pump())

    async def meets(self, *system_ids: int) -> None:
        """Wait until these have been heard, so that what is said to them arrives."""
        await until(lambda: self._heard.issuperset(system_ids))

    def say(self, message: Message, to: int) -> None:
        self._link.send(*encode_payload(message), to)

    def say_bytes(self, payload_type: int, payload: bytes, to: int) -> None:
        self._link.send(payload_type, payload, to)

    def hand(self, kind: BlobKind, blob: bytes, to: int) -> None:
        """Send a blob."""
        self._transfers.submit(to, kind, blob, asyncio.get_running_loop().time())

    def heard(self) -> list[Message]:
        """Take the messages that have come so far."""
        return [self.messages.get_nowait() for _ in range(self.messages.qsize())]

    async def asked(self) -> FrameRequest:
        """Wait for the next request for a frame."""
        while True:
            message = await self.messages.get()
            if isinstance(message, FrameRequest):
                return message

    async def answer(self) -> tuple[bytes, FrameAnswer]:
        """Wait for the next frame, as bytes and read."""
        received = await self.blobs.get()
        assert received.kind == BlobKind.FRAME_ANSWER
        return received.blob, decode_frame(received.blob)

    async def update_and_held(self, own_image: bytes) -> tuple[bytes, dict[bytes, bytes]]:
        """Wait for an encoded update; return it and the images held by then, by their names."""
        held = {name_of_image(own_image): own_image}
        while True:
            received = await self.blobs.get()
            if received.kind == BlobKind.PASSED_FRAME:
                image = decode_frame(received.blob, BlobKind.PASSED_FRAME).image_bytes
                held[name_of_image(image)] = image
            if received.kind == BlobKind.MAP_UPDATE:
                return received.blob, held

    def _hear(self, tunnel: Tunnel) -> None:
        self._heard.add(tunnel.sender_system)
        message = decode_payload(tunnel.payload_type, tunnel.payload)
        if not isinstance(message, Chunk | TransferStatus):
            self.messages.put_nowait(message)
            return
        now_s = asyncio.get_running_loop().time()
        self._take(self._transfers.receive(tunnel.sender_system, message, now_s))

    async def _pump(self) -> None:
        while True:
            outgoing, events = self._transfers.poll(asyncio.get_running_loop().time())
            self._take(events)
            for payload in outgoing:
                self._link.send(payload.payload_type, payload.payload, payload.peer)
            await asyncio.sleep(0.002)

    def _take(self, events: list[Event]) -> None:
        for event in events:
            if isinstance(event, BlobReceived):
                self.blobs.put_nowait(event)


class Swarm:
    """Starts and stops the members of one swarm."""

    def __init__(self, members: tuple[int, ...], path: Path, stack: contextlib.AsyncExitStack):
        self._members = members
        self._path = path
        self._key = path.resolve() / "swarm.key"
        make_key_file(self._key)
        self._stack = stack
        ports = free_ports(len(members))
        self._addresses = {m: f"127.0.0.1:{p}" for m, p in zip(members, ports, strict=True)}
        self._n_started = 0
        self._lives: dict[int, contextlib.AsyncExitStack] = {}

    async def start(
        self,
        system_id: int,
        flies_on: tuple[int, ...] = (),
        transfer: TransferOptions = FAST,
        inter: InterMavOptions = INTER,
        update: UpdateOptions = NO_UPDATES,
        runs: bool = True,
        directory: str = "",
    ) -> Drone:
        """Start a drone that only talks, and sees what the test says it sees; see ``_start``."""
        return await self._start(
            Drone, system_id, flies_on, transfer, inter, update, runs, directory
        )

    async def fly(
        self,
        system_id: int,
        flies_on: tuple[int, ...] = (),
        transfer: TransferOptions = FAST,
        update: UpdateOptions = NO_UPDATES,
        directory: str = "",
        north_deg: float = 0.0,
        heading: Heading = "map",
    ) -> Flyer:
        """Start a drone that flies, its autopilot's north turned by so much; see ``_start``."""
        return await self._start(
            Flyer,
            system_id,
            flies_on,
            transfer,
            INTER,
            update,
            True,
            directory,
            north_deg,
            heading,
        )

    async def _start(
        self,
        kind: type[_Kind],
        system_id: int,
        flies_on: tuple[int, ...],
        transfer: TransferOptions,
        inter: InterMavOptions,
        update: UpdateOptions,
        runs: bool,
        directory: str,
        north_deg: float = 0.0,
        heading: Heading = "map",
    ) -> _Kind:
        """Start a drone at the instant of its first frame, flying on the map of some if given."""
        life = await self._stack.enter_async_context(contextlib.AsyncExitStack())
        self._lives[system_id] = life
        self._n_started += 1
        shot = demo.shot(system_id)
        clock = ManualClock(shot.at_ns)
        executor = life.enter_context(Worker("beside"))
        north = Pose(exp_so3(np.deg2rad([0.0, 0.0, north_deg])), np.zeros(3))
        quaternion = (north @ shot.ned_from_body).quaternion()
        autopilot = await life.enter_async_context(
            autopilot_and_link(system_id, clock, shot.at_ns, quaternion)
        )
        log_path = self._path / f"{system_id}-{self._n_started}.jsonl"
        drone = kind(
            system_id, self._members, self._peers(system_id), autopilot, clock, executor,
            log_path, transfer, inter, update, self._n_started, directory, north_deg, heading,
        )  # fmt: skip
        life.callback(drone.close)
        if flies_on:
            drone.maps.replace(
                demo.encoded_map(*flies_on),
                demo.map_index(*flies_on),
                templates=demo.templates(*flies_on),
            )
        if runs:
            await self.begin(drone)
        return drone

    async def begin(self, drone: Drone) -> None:
        """Have a drone run that does not yet."""
        await self._lives[drone.system_id].enter_async_context(beside(drone.run()))
        await drone.autopilot.states.get()

    async def stop(self, drone: Drone | Stranger, *, dies: bool = False) -> None:
        """End a drone, as somebody who asks for that, or as it is killed."""
        if isinstance(drone, Drone) and not dies:
            drone.in_flight.ended()
        await self._lives[drone.system_id].aclose()

    async def stranger(self, system_id: int) -> Stranger:
        """Start a member that is played by the test."""
        life = await self._stack.enter_async_context(contextlib.AsyncExitStack())
        self._lives[system_id] = life
        stranger = Stranger(system_id, self._members, self._peers(system_id))
        await life.enter_async_context(beside(stranger.run()))
        return stranger

    def _peers(self, system_id: int) -> PeerOptions:
        others = tuple(a for m, a in self._addresses.items() if m != system_id)
        remembered = str(self._path / f"{system_id}-signing.json")
        return PeerOptions(self._addresses[system_id], others, str(self._key), remembered)


@contextlib.asynccontextmanager
async def swarm(*members: int, path: Path) -> AsyncIterator[Swarm]:
    """A swarm whose members are started by the test, and ended behind it."""
    async with contextlib.AsyncExitStack() as stack:
        yield Swarm(members, path, stack)


def tunnel(sender: int, payload_type: int, payload: bytes) -> Tunnel:
    """What a link hands over of a payload to everybody."""
    return Tunnel(sender, COMPANION, 0, payload_type, payload)


def said(sender: int, message: Message) -> Tunnel:
    """What a link hands over of a message to everybody."""
    payload_type, payload = encode_payload(message)
    return tunnel(sender, payload_type, payload)
