"""A flight's outcome, gathered from what it left on disk and compared with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sitl.evaluation import (
    Estimates,
    Scores,
    pose_errors,
    ref_from_world,
    scores,
)
from sitl.firmware import FirmwareBinary
from sitl.flight_log import FlightLog, MapRow, PropagatedRow, estimates_of, read_received
from sitl.flown_mission import read_mission
from sitl.fused import read_fused
from sitl.lives import Life, Lives, read_lives, read_log
from sitl.network_log import NetworkLog, read_network_log
from sitl.plan import FlightPlan, PlannedDrone
from sitl.processes import FlightError
from sitl.recording_axes import axes_from_ned
from sitl.result import DroneResult, Event, FlightResult
from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.wire.map_codec import decode_map

# A pose is about a frame: usec cuts its instant to a microsecond, and a clock
# that is carried over twice may cost a few more.
_SAME_FRAME_NS = 1_000_000


def gather(plan: FlightPlan, out: Path, events: Iterable[Event] = ()) -> FlightResult:
    """Read what daemons and stand-ins wrote under ``out``, and compare it with the truth.

    Args:
        plan: the flight.
        out: its output folder.
        events: what the harness itself has to say.

    Raises:
        FlightError: a file is missing or broken; names it.
    """
    lives = read_lives(out)
    logs = {d.name: read_log(out / "run" / d.name, lives.get(d.name)) for d in plan.drones}
    truths = {d.name: _truth_at_frames(d) for d in plan.drones}
    received = {
        d.name: _apart(
            read_received(out / d.name / "received.jsonl", d.system_id), logs[d.name].propagated
        )
        for d in plan.drones
    }
    heard = {
        d.name: _of_given(lives.get(d.name), *_on_frames(d, received[d.name][0]))
        for d in plan.drones
    }
    network = read_network_log(out)
    alignment = _alignment(*heard[plan.leader], truths[plan.leader])
    firmware = plan.options.firmware
    drones = tuple(
        _drone_result(
            d,
            out,
            truths[d.name],
            *heard[d.name],
            received[d.name][1],
            logs[d.name],
            alignment,
            lives.get(d.name),
            firmware,
            waits_for_map=d.name in plan.waited_for,
        )
        for d in plan.drones
    )
    mapped_by = _whose_maps(plan, logs, lives)
    maps = logs[mapped_by].maps
    points = _map_points(out / "run" / mapped_by / "maps", maps)
    said = [*events, *_logged(plan, logs), *(e for d in drones for e in _doubts(d))]
    said += _left_out(plan)
    if network is not None:
        said += _network_doubts(network)
    if alignment is None and any(d.truth and any(d.truth) for d in drones):
        why = f"{plan.leader} has no estimate with a truth: nothing is compared with the truth"
        said.append(Event(0.0, plan.leader, "harness", why))
    return FlightResult(
        plan=plan,
        drones=drones,
        ref_from_world=alignment,
        maps=maps,
        points_ref_m=points if alignment is None else alignment.apply(points),
        events=tuple(sorted(said, key=lambda event: event.at_s)),
        network=network,
    )


def _drone_result(
    planned: PlannedDrone,
    out: Path,
    truth: tuple[Pose | None, ...],
    estimates: Estimates,
    frame_of: NDArray[np.int64],
    between: Estimates,
    log: FlightLog,
    alignment: Pose | None,
    lives: Lives | None,
    firmware: FirmwareBinary | None,
    *,
    waits_for_map: bool,
) -> DroneResult:
    errors = None
    every = range(len(planned.drone.frames))
    if alignment is not None:
        true = tuple(truth[n] if n >= 0 else None for n in frame_of.tolist())
        errors = pose_errors(estimates, true, alignment)
    axes = axes_from_ned(planned.drone.sensor.reference_axes)
    has_own_height = firmware is not None and firmware.has_own_height(
        flies_itself=planned.mission is not None
    )
    return DroneResult(
        name=planned.name,
        frames_at_ns=planned.frames_at_ns,
        truth=truth,
        estimates=estimates,
        frame_of=frame_of,
        log=log,
        errors=errors if errors is not None and len(errors.at_ns) else None,
        scores=scores(errors, axes) if errors is not None else None,
        n_between=len(between.at_ns),
        between=None if alignment is None else _between(planned, between, alignment, axes),
        alone={} if alignment is None else _alone(planned, truth, log, alignment, axes),
        fused=read_fused(
            out / planned.name,
            estimates,
            planned.drone.truth,
            alignment,
            has_own_height=has_own_height,
            holds_at_rest=firmware is not None and firmware.holds_at_rest,
        ),
        mission=read_mission(
            out / planned.name, planned.drone.truth, alignment, has_own_height=has_own_height
        ),
        given=np.array(every if lives is None else lives.frames, dtype=np.int64),
        lives=() if lives is None else tuple(lives.lives),
        waits_for_map=waits_for_map,
        axes=planned.drone.sensor.reference_axes,
    )


def _alone(
    planned: PlannedDrone,
    truth: tuple[Pose | None, ...],
    log: FlightLog,
    alignment: Pose,
    axes: Array,
) -> dict[str, Scores]:
    """Return how good fixes and proposals were by themselves, before anything was fused."""
    true = dict(zip(planned.frames_at_ns.tolist(), truth, strict=True))
    out = {}
    for source in ("intra", "inter"):
        rows = [row for row in log.estimates if row.source == source]
        at_frames = tuple(true.get(row.captured_at_ns) for row in rows)
        found = scores(pose_errors(estimates_of(rows), at_frames, alignment), axes)
        if found is not None:
            out[source] = found
    return out


def _apart(received: Estimates, propagated: Sequence[PropagatedRow]) -> tuple[Estimates, Estimates]:
    """Return what frames gave of what was received, and what the daemon says lies between."""
    known = np.array([row.at_ns // 1000 for row in propagated], dtype=np.int64)
    lies_between = np.isin(received.at_ns // 1000, known)
    return _chosen(received, ~lies_between), _chosen(received, lies_between)


def _chosen(estimates: Estimates, which: NDArray[np.bool_]) -> Estimates:
    kept = np.flatnonzero(which)
    poses = tuple(estimates.world_from_body[n] for n in kept)
    return replace(
        estimates,
        at_ns=estimates.at_ns[kept],
        world_from_body=poses,
        covariances=estimates.covariances[kept],
        reset_counters=estimates.reset_counters[kept],
    )


def _between(
    planned: PlannedDrone, between: Estimates, alignment: Pose, axes: Array
) -> Scores | None:
    """Return how good the poses between frames were, by the truth between its own instants."""
    truth = planned.drone.truth
    if truth is None:
        return None
    true = tuple(truth.pose_at(at_ns) for at_ns in between.at_ns.tolist())
    return scores(pose_errors(between, true, alignment), axes)


def _truth_at_frames(planned: PlannedDrone) -> tuple[Pose | None, ...]:
    truth = planned.drone.truth
    return tuple(truth.pose_at(f.at_ns) if truth else None for f in planned.drone.frames)


def _on_frames(planned: PlannedDrone, received: Estimates) -> tuple[Estimates, NDArray[np.int64]]:
    """Give estimates the exact instants of the frames that they are about."""
    frames = planned.frames_at_ns
    after = np.clip(np.searchsorted(frames, received.at_ns), 1, max(1, len(frames) - 1))
    before = after - 1
    after = np.minimum(after, len(frames) - 1)
    closer = np.abs(frames[after] - received.at_ns) < np.abs(received.at_ns - frames[before])
    nearest = np.where(closer, after, before)
    fits = np.abs(frames[nearest] - received.at_ns) <= _SAME_FRAME_NS
    at_ns = np.where(fits, frames[nearest], received.at_ns)
    exact = replace(received, at_ns=at_ns)
    return exact, np.where(fits, nearest, -1)


def _of_given(
    lives: Lives | None, estimates: Estimates, frame_of: NDArray[np.int64]
) -> tuple[Estimates, NDArray[np.int64]]:
    """Leave out poses of frames that a daemon had in hand when it was killed."""
    if lives is None or not any(life.killed_at_ns is not None for life in lives.lives):
        return estimates, frame_of
    kept = (frame_of < 0) | np.isin(frame_of, np.array(lives.frames))
    return _chosen(estimates, kept), frame_of[kept]


def _whose_maps(plan: FlightPlan, logs: Mapping[str, FlightLog], lives: Mapping[str, Lives]) -> str:
    """Return whose maps are told of: the leader's, unless others went on without it."""

    def went_on(name: str) -> bool:
        last = lives[name].lives[-1:] if name in lives else [Life(0)]
        return bool(logs[name].maps) and any(life.killed_at_ns is None for life in last)

    names = [plan.leader, *(d.name for d in plan.drones)]
    return next(filter(went_on, names), plan.leader)


def _alignment(
    estimates: Estimates, frame_of: NDArray[np.int64], truth: tuple[Pose | None, ...]
) -> Pose | None:
    """Return ref_from_world by the leader's first estimate that has a truth."""
    for estimate, n in zip(estimates.world_from_body, frame_of.tolist(), strict=True):
        true = truth[n] if n >= 0 else None
        if true is not None:
            return ref_from_world(true, estimate)
    return None


def _map_points(folder: Path, maps: Sequence[MapRow]) -> Array:
    """Return the (N, 3) landmarks of the last map, world frame, m."""
    if not maps:
        return np.empty((0, 3))
    path = folder / f"{maps[-1].revision}.vclmap"
    try:
        return decode_map(path.read_bytes()).points_world
    except OSError as error:
        raise FlightError(f"{path}: {error.strerror}") from error
    except WireError as error:
        raise FlightError(f"{path}: {error}") from error


def _logged(plan: FlightPlan, logs: dict[str, FlightLog]) -> list[Event]:
    return [
        # A daemon that was not told the time yet has said 0.
        Event(
            (row.at_ns - plan.starts_at_ns) * 1e-9 if row.at_ns else 0.0,
            name,
            row.event,
            row.reason or "",
        )
        for name, log in logs.items()
        for row in log.events
    ]


def _left_out(plan: FlightPlan) -> list[Event]:
    """Return whose frames were not flown, as no first map can be made of them."""
    return [
        Event(
            0.0,
            drone.name,
            "harness",
            f"{drone.n_left_out} frames not flown: from before all are there for a first map",
        )
        for drone in plan.drones
        if drone.n_left_out
    ]


def _doubts(drone: DroneResult) -> list[Event]:
    """Return what does not add up, so that nobody has to find it."""
    out = []
    if drone.unaccounted:
        out.append(f"{drone.unaccounted} of {drone.n_frames} frames are not accounted for")
    strangers = int(np.sum(drone.frame_of < 0))
    if strangers:
        out.append(f"{strangers} poses carry the time of no frame")
    logged = drone.log.count("localized") - sum(f.is_held_back for f in drone.log.frames)
    if logged != drone.n_localized:
        out.append(f"{logged} frames localized by the log, {drone.n_localized} poses received")
    coasted = sum(frame.by == "motion" for frame in drone.log.frames)
    if coasted != drone.n_coasted:
        out.append(f"{coasted} frames by motion by the log, {drone.n_coasted} poses received")
    return [Event(0.0, drone.name, "harness", text) for text in out]


def _network_doubts(network: NetworkLog) -> list[Event]:
    """Return what happened to datagrams that no option asked for."""
    out = []
    if network.n_dropped:
        out.append(f"{network.n_dropped} datagrams were lost by the harness, not by the network")
    if network.n_strangers:
        out.append(f"{network.n_strangers} datagrams came from no daemon of this flight")
    return [Event(0.0, "network", "harness", text) for text in out]
