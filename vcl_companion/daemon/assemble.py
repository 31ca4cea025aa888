"""The one place where the parts of the daemon are made and joined."""

from __future__ import annotations

import asyncio
import gc
import logging
import signal
import sys
import time
from collections.abc import Coroutine
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from vcl_companion.cameras.mounting import mounting_text, read_calibration
from vcl_companion.cameras.open import open_camera
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.clock import Clock, ManualClock, SystemClock
from vcl_companion.compiled import pack_kernels
from vcl_companion.config import Config
from vcl_companion.daemon import notify
from vcl_companion.daemon.catching_up import CatchingUp
from vcl_companion.daemon.commands import Commands
from vcl_companion.daemon.companion import Companion
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.exchange import Exchange, ExchangeOptions
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.forked import END_SIGNALS
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.local_frame import origin_in_leaders_world
from vcl_companion.daemon.map_in_flight import MapInFlight
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.memory_watch import MemoryWatch
from vcl_companion.daemon.message_requests import MessageRequests
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.onboard_computer import OnboardComputer
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.daemon.peer_poses import PeerPoses
from vcl_companion.daemon.saved_map import SavedMap
from vcl_companion.daemon.scheduling import run_before_others
from vcl_companion.daemon.settings import open_settings
from vcl_companion.daemon.status_writer import StatusWriter
from vcl_companion.daemon.teller import Teller
from vcl_companion.daemon.usage import (
    cpu_s,
    forget_peak,
    give_back_files,
    give_back_freed,
    peak_resident_mb,
    share_freed,
)
from vcl_companion.daemon.worker import Worker
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.errors import VclError
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.peers import PeerLink, open_signing
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import Transfers
from vcl_companion.wire.warm_up import warm_up

_log = logging.getLogger(__name__)

# A device that does not let go must not keep the flight log from its summary.
_CLOSE_S = 3.0
_SWITCH_S = 0.0005
_N_READERS = 4
# A clock that a stream tells the time moves in steps of 20 ms, and is told them late when
# there is much to do.
_TOLD_CLOCK_RESOLUTION_NS = 100_000_000


def run_daemon(config: Config) -> int:
    """Run one drone's service until SIGTERM, SIGHUP, Ctrl-C or the end of the camera's stream.

    Args:
        config: everything it can be told.

    Returns:
        Exit status 0: the end was asked for, or the stream was over.

    Raises:
        VclError: the configuration or a device cannot be used.
    """
    # One core per thing: several daemons may share a machine, and OpenCV's own
    # threads make features depend on their number.
    cv2.setNumThreads(1)
    share_freed()
    # A frame takes the interpreter's lock some dozen times; whoever makes a map beside it
    # gives it up after so long.
    sys.setswitchinterval(_SWITCH_S)
    try:
        return asyncio.run(_run(config))
    finally:
        # The interpreter gives handlers back to the system before it has ended:
        # a second SIGTERM must not kill what is about to end cleanly.
        for number in END_SIGNALS:
            signal.signal(number, signal.SIG_IGN)


async def _run(config: Config) -> int:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    def end(*_: object) -> None:
        with suppress(RuntimeError):  # asked for again when the loop is closed already
            loop.call_soon_threadsafe(ended.set)

    # Not the loop's own handlers: those vanish with it, and a second SIGTERM
    # would then kill a daemon that is about to end cleanly.
    for number in END_SIGNALS:
        # `nohup` has the end of the terminal ignored.
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)
    clock: Clock = ManualClock() if config.clock == "camera" else SystemClock()
    sensor = read_calibration(config.camera)
    log = FlightLog(config.log.flight_log, clock)
    maps = MapStore(config.map.directory)
    signing = open_signing(config.peers)
    group = Group(config.swarm, config.system_id)
    camera = open_camera(config.camera, sensor, clock)
    autopilot = AutopilotLink(config.autopilot, config.system_id, clock)
    health = Health(autopilot, log)
    outcomes = FrameOutcomes(camera, clock, health, log)
    tracked = config.pipeline == "default"
    # The paper's pipeline sends what it has measured, and nothing else.
    motion = config.filter if tracked else replace(config.filter, coast_s=0.0)
    told = config.autopilot if tracked else replace(config.autopilot, min_rate_hz=0.0)
    estimator = Estimator(
        motion,
        config.localization,
        lambda why: log.event("jump", why),
        keeps_local=config.swarm.keeps_local,
        heading=config.autopilot.heading,
        has_heading=lambda: autopilot.has_heading,
    )
    autopilot.origin.origin_world = lambda: origin_in_leaders_world(
        estimator.local, group, maps.current
    )
    _log.info("the camera's %s", mounting_text(sensor.body_from_cam.rotation))
    vision = Worker("vision")
    # Before anybody is told that we are here: no frame has to wait for the compiler.
    notify.status("compiling, once on this machine")
    warm = loop.run_in_executor(vision, warm_up)
    stop = loop.create_task(ended.wait())
    await asyncio.wait((warm, stop), return_when=asyncio.FIRST_COMPLETED)
    stop.cancel()
    if warm.done():
        await warm
    # What is there now stays for good: no later collection looks at it again, which took
    # a tenth of a second and the interpreter's lock.
    pack_kernels()
    gc.collect()
    gc.freeze()
    began_mb = peak_resident_mb()
    give_back_freed()
    give_back_files()
    forget_peak()
    # The paper's pipeline would leave nothing to others: a frame takes longer than it may.
    realtime = tracked and config.scheduling == "realtime"
    pipeline = PipelineOptions(
        config.features, config.localization, config.tracking, config.system_id
    )
    building = replace(config.map, patches=config.map.patches and tracked)
    # Frames never wait for a map that is being built, nor for one that is looked for all over
    # it: that is another process, begun while no threads are at work that it would not have.
    work = MapWork(
        Workshop(
            sensor,
            WorkOptions(
                config.swarm.known_distances,
                building,
                pipeline,
                config.recognised_by(),
                config.inter,
                tracked,
            ),
        ),
        forks=True,
        realtime=realtime,
    )
    if realtime:
        vision.submit(run_before_others)
        # Cameras are read, and their images decoded, by threads of the loop's.
        loop.set_default_executor(
            ThreadPoolExecutor(_N_READERS, "camera", initializer=run_before_others)
        )
        if not run_before_others():
            _log.info("frames wait for other programs: no real-time scheduling for this user")
    disk = Worker("disk")
    rng = np.random.default_rng()
    exchange = Exchange(
        config.system_id,
        group,
        Transfers(config.transfer, rng),
        maps,
        autopilot,
        sensor,
        clock,
        log,
        work,
        disk,
        estimator,
        ExchangeOptions(
            config.swarm,
            building,
            config.update,
            config.recognised_by(),
            config.inter,
            tracked,
            _TOLD_CLOCK_RESOLUTION_NS if isinstance(clock, ManualClock) else 0,
        ),
        rng,
    )
    teller = Teller(autopilot, estimator, clock, log, told)
    odometry = Odometry(sensor, config.system_id, work)
    own_fixes = OwnFixes(sensor, autopilot, maps, estimator, log, vision, pipeline, odometry)
    companion = Companion(
        camera,
        outcomes,
        own_fixes,
        CatchingUp(config.system_id, exchange.frames, maps, estimator, own_fixes),
        PeerPoses(exchange.inter, maps, estimator, log),
        teller,
        maps,
        estimator,
        exchange.on_frame,
        health,
        work,
        config.update.frame_wait_s,
    )
    peers = PeerLink(
        config.peers,
        config.system_id,
        frozenset(group.members),
        exchange.on_tunnel,
        exchange.on_heartbeat,
        clock,
        exchange.clocks.answered,
        signing,
        disk,
        lambda: group.stretch,
    )
    exchange.attach(peers)
    if isinstance(camera, StreamCamera):  # no other camera asks, or is asked for each frame
        camera.is_busy = exchange.is_busy
        camera.left_out = outcomes.undecodable
    in_flight = MapInFlight(maps, disk)
    saved = SavedMap(maps, in_flight, exchange.go_back_to, estimator, disk, autopilot, log)
    requests = MessageRequests(autopilot, OnboardComputer(Path()), disk)
    commands = Commands(autopilot, exchange, maps, estimator, teller, saved, requests, log)
    parameters = open_settings(autopilot, exchange, commands, log)

    async def exchanging() -> None:
        await saved.begin()  # before anybody makes a first map
        async with asyncio.TaskGroup() as parts:
            parts.create_task(in_flight.run())
            parts.create_task(exchange.run())

    memory = MemoryWatch(work.pid)
    watching = [health.run(), requests.run(), parameters.run(), memory.run()]
    if config.log.status_file:
        status = StatusWriter(
            Path(config.log.status_file),
            *(config.system_id, health, autopilot, estimator, maps, group, disk),
        )
        watching.append(status.run())
    began_at_s, began_cpu_s = time.monotonic(), cpu_s()
    try:
        await _until_ended(
            ended,
            autopilot.run(),
            peers.run(),
            exchanging(),
            companion.run(),
            *watching,
            ends_all=companion.read_camera(),
        )
        in_flight.ended()
    finally:
        try:
            outcomes.end()
            with suppress(TimeoutError):
                async with asyncio.timeout(_CLOSE_S):
                    await camera.close()
        finally:
            # What still runs is not waited for: an update takes seconds, and nobody wants it.
            for worker in (vision, disk):
                worker.shutdown(wait=False, cancel_futures=True)
            most_mb = memory.most_mb() or peak_resident_mb()
            works_cpu_s = work.end()
            log.close(
                cpu_s=cpu_s() - began_cpu_s + works_cpu_s,
                wall_s=time.monotonic() - began_at_s,
                resident_mb=max(began_mb, most_mb),
                peer_bytes_sent=peers.counters.bytes_out,
                peer_bytes_received=peers.counters.bytes_in,
                quarantined=dict(exchange.trust.n_terms),
            )
    for worker in (vision, disk):
        worker.exit_status = 0
    work.ends_with(0)
    return 0


async def _until_ended(
    ended: asyncio.Event,
    *parts: Coroutine[None, None, None],
    ends_all: Coroutine[None, None, None],
) -> None:
    """Run every part until the end is asked for, or ``ends_all`` is done, or one fails."""
    tasks = [asyncio.ensure_future(part) for part in (*parts, ends_all)]
    stop = asyncio.ensure_future(ended.wait())
    notify.ready()
    try:
        await asyncio.wait({*tasks, stop}, return_when=asyncio.FIRST_COMPLETED)
    finally:
        notify.stopping()
        for task in (*tasks, stop):
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    for result in results:
        if isinstance(result, BaseException) and not isinstance(result, asyncio.CancelledError):
            cause = _first_cause(result)
            if ended.is_set() and isinstance(cause, VclError):
                # Who ends us may hang up at the same moment.
                _log.warning("while ending: %s", cause)
                continue
            raise cause


def _first_cause(error: BaseException) -> BaseException:
    """Unwrap a task group's failure, so that an expected one stays one line."""
    while isinstance(error, BaseExceptionGroup):
        expected = error.subgroup(VclError)
        error = (expected or error).exceptions[0]
    return error
