"""A flight as real processes would have left it on disk, with known errors; no process runs."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sitl.evaluation import upper_from_covariance
from sitl.network import NetworkOptions
from sitl.network_log import NetworkLog
from sitl.out_folder import prepare_folder
from sitl.partitions import Partition
from sitl.plan import FlightPlan, FlyOptions, plan_flight
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    Array,
    euler_from_matrix,
    matrix_from_euler,
    quaternion_from_matrix,
)
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.recording import (
    BODY_FROM_CAM_FORWARD,
    Description,
    KnownPair,
    RecordingWriter,
    ReferenceAxes,
    Sensor,
    Trajectory,
    read_recording,
)
from vcl_companion.wire.map_codec import encode_map, revision_of

CAMERA = Camera(16, 12, 14.0, 14.0, 7.5, 5.5)
FORWARD = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
START_NS = 1_721_300_000_123_456_789
PERIOD_NS = 200_000_000
# The daemons' world against the recording's NED: moved and turned about the vertical.
NED_FROM_WORLD = Pose(matrix_from_euler(0.0, 0.0, 1.1), np.array([3.0, -2.0, -4.5]))
SIGMAS = np.array([0.05, 0.08, 0.04, 0.004, 0.004, 0.01])

ErrorOf = Callable[[str, int], Array]


@dataclass(frozen=True)
class Flight:
    """What happened in it.

    Attributes:
        n_frames: of each drone.
        n_drones: mav0, mav1, ...
        axes: of the recording's files.
        with_truth: whether the recording has ground truth.
        refused: (drone, frame) without a pose.
        dropped: (drone, frame) never looked at.
        unlogged: (drone, frame) that the daemon's log forgets.
        proposed: (drone, frame) that a peer said a pose of, and how far it was off, m;
            without a fix of its own such a frame has only that.
        starved: (drone, frame) without a fix of its own.
        held_back: (drone, frame) localized, and not sent.
        between: (drone, frame) that a pose halfway to the next was sent after, and how far it
            was off, m.
        coasted: (drone, frame) refused, and sent by attitude and motion alone.
        network: what the relay between the drones counted, if it did.
        features: (drone, frame) whose own fix rests on features, not on patches.
        odometry: (drone, frame) whose own fix rests on the drone's own last frames.
        partitions: in which some did not hear others.
        reset: (drone, frame) from which on the autopilot is told of a reset.
        error: (drone, frame) to the (6,) error of its pose, as MAVLink puts it.
    """

    n_frames: int = 12
    n_drones: int = 2
    axes: ReferenceAxes = "NED"
    with_truth: bool = True
    refused: frozenset[tuple[str, int]] = frozenset()
    dropped: frozenset[tuple[str, int]] = frozenset()
    unlogged: frozenset[tuple[str, int]] = frozenset()
    proposed: Mapping[tuple[str, int], float] = field(default_factory=dict)
    starved: frozenset[tuple[str, int]] = frozenset()
    held_back: frozenset[tuple[str, int]] = frozenset()
    between: Mapping[tuple[str, int], float] = field(default_factory=dict)
    coasted: frozenset[tuple[str, int]] = frozenset()
    features: frozenset[tuple[str, int]] = frozenset()
    odometry: frozenset[tuple[str, int]] = frozenset()
    network: NetworkLog | None = None
    partitions: tuple[Partition, ...] = ()
    reset: tuple[str, int] | None = None
    error: ErrorOf = field(default=lambda _drone, _frame: np.zeros(6))


def ned_from_body(n: int, k: int) -> Pose:
    """Return drone n's true pose at frame k."""
    rotation = matrix_from_euler(0.02 * np.sin(k), -0.03, 0.4 * n + 0.05 * k)
    return Pose(rotation, np.array([0.4 * k, 2.0 * n - 0.1 * k, -5.0 - 0.2 * n]))


def at_ns(n: int, k: int) -> int:
    """Return when; drones are a few milliseconds apart."""
    return START_NS + k * PERIOD_NS + 3_000_000 * n


def write_recording(path: Path, flight: Flight) -> Path:
    description = Description("paper <&>", 5.0, "mav0", (KnownPair("mav0", "mav1", 2.0),))
    with RecordingWriter(path, description) as writer:
        for n in range(flight.n_drones):
            times = [at_ns(n, k) for k in range(flight.n_frames)]
            poses = [ned_from_body(n, k) for k in range(flight.n_frames)]
            truth = Trajectory.from_poses(times, poses) if flight.with_truth else None
            writer.add_drone(f"mav{n}", Sensor(CAMERA, FORWARD, 5.0, flight.axes), truth)
            for k, instant in enumerate(times):
                image = np.full((CAMERA.height_px, CAMERA.width_px), 10 * n + k, dtype=np.uint8)
                writer.add_frame(f"mav{n}", instant, image)
    return path


def leave_behind(tmp_path: Path, flight: Flight) -> tuple[FlightPlan, Path]:
    """Write recording, logs and received messages; return the plan and the output folder."""
    recording = write_recording(tmp_path / "recording", flight)
    attitude = None
    if not flight.with_truth:
        attitude = tmp_path / "earlier"
        for n in range(flight.n_drones):
            (attitude / f"mav{n}").mkdir(parents=True)
            (attitude / f"mav{n}" / "attitude.csv").write_text("at_ns,qw,qx,qy,qz\n")
    plan = plan_flight(
        read_recording(recording),
        FlyOptions(attitude=attitude, network=NetworkOptions(partitions=flight.partitions)),
    )
    out = tmp_path / "out"
    prepare_folder(out, plan)
    encoded = encode_map(_landmark_map())
    revision = revision_of(encoded).hex()
    for n, planned in enumerate(plan.drones):
        run = out / "run" / planned.name
        (run / "maps" / f"{revision}.vclmap").write_bytes(encoded)
        _write_lines(run / "flight.jsonl", _log(planned.name, n, flight, revision, len(encoded)))
        _write_lines(out / planned.name / "received.jsonl", _received(planned.name, n, flight))
    if flight.network is not None:
        (out / "run" / "network.json").write_bytes(msgspec.json.encode(flight.network))
    return plan, out


def _landmark_map() -> LandmarkMap:
    points = np.random.default_rng(9).uniform([5, -8, -9], [12, 8, 1], (200, 3))
    keyframe = Keyframe(1, START_NS, Pose.identity(), FORWARD, CAMERA, b"an image")
    seen_px = np.full((200, 1, 2), 4.0)
    return LandmarkMap((keyframe,), points, seen_px, 0.3, ("akaze",), (), b"")


def _log(name: str, n: int, flight: Flight, revision: str, n_bytes: int) -> list[dict[str, Any]]:
    start = {"at_ns": at_ns(n, 0)}
    lines: list[dict[str, Any]] = [
        {"kind": "map", **start, "revision": revision, "landmarks": 200, "bytes": n_bytes,
         "keyframes": 1},
        {"kind": "event", **start, "event": "map", "reason": "first map"},
        {"kind": "something newer than this harness", "x": 1},
    ]  # fmt: skip
    for k in range(flight.n_frames):
        if (name, k) in flight.unlogged:
            continue
        outcome, reason = "localized", None
        if (name, k) in flight.refused | flight.coasted:
            outcome, reason = "refused", "9 of 30 <landmarks>"
        if (name, k) in flight.dropped:
            outcome = "dropped"
        source = None
        if outcome == "localized":
            source = "intra" if (name, k) not in flight.proposed else "fused"
            source = "inter" if (name, k) in flight.starved else source
        by: str | None = "features" if (name, k) in flight.features else "patches"
        by = "odometry" if (name, k) in flight.odometry else by
        by = "peer" if source == "inter" else by
        if (name, k) in flight.held_back:
            by, reason = None, "held back: more than 30 poses a second"
        if (name, k) in flight.between:
            between_ns = at_ns(n, k) + PERIOD_NS // 2
            lines.append({"kind": "propagated", "at_ns": between_ns, "since_fix_s": 0.1})
        if source is None:
            by = "motion" if (name, k) in flight.coasted else None
        if source in ("intra", "fused"):
            lines.append(_estimate(n, k, flight.error(name, k)))
        if (name, k) in flight.proposed:
            off = np.array([flight.proposed[name, k], 0, 0, 0, 0, 0])
            lines.append(_estimate(n, k, off, host=3))
        lines.append(
            {"kind": "frame", "source": source, "sequence": k, "captured_at_ns": at_ns(n, k),
             "outcome": outcome,
             "reason": reason, "latency_ms": _latency_ms(k, outcome), "matched": 150 - k,
             "inliers": 100 - k, "by": by}
        )  # fmt: skip
    lines.append(
        {"kind": "summary", "frames": {}, "refusals": {}, "cpu_s": 1.5, "wall_s": 3.0,
         "resident_mb": 120.0, "peer_bytes_sent": 4400, "peer_bytes_received": 0}
    )  # fmt: skip
    return lines


def _estimate(n: int, k: int, error: Array, host: int | None = None) -> dict[str, Any]:
    """Return what the log says of a fix, or of a host's proposal; one beyond 1 m is not fused."""
    truth = NED_FROM_WORLD.inverse() @ ned_from_body(n, k)
    roll, pitch, yaw = np.add(euler_from_matrix(truth.rotation), error[3:])
    far = bool(np.linalg.norm(error[:3]) > 1.0)
    return {
        "kind": "estimate", "captured_at_ns": at_ns(n, k), "host": host,
        "source": "intra" if host is None else "inter",
        "position": (truth.translation + error[:3]).tolist(),
        "quaternion": quaternion_from_matrix(matrix_from_euler(roll, pitch, yaw)).tolist(),
        "covariance": upper_from_covariance(np.diag(SIGMAS**2)).tolist(),
        "fused": not far, "reason": "far off" if far else None,
    }  # fmt: skip


def _latency_ms(k: int, outcome: str) -> float | None:
    """Return 21, 22, ... ms; the first frame waits for the map, a dropped one has none."""
    if outcome == "dropped":
        return None
    return 900.0 if k == 0 else 20.0 + k


def _received(name: str, n: int, flight: Flight) -> list[dict[str, Any]]:
    """Return what the autopilot heard: heartbeats, a stranger's pose, and its own poses."""
    stranger = {"system": 77, "component": 197, "type": "VISION_POSITION_ESTIMATE", "fields": {}}
    heartbeat = {"system": n + 1, "component": 197, "type": "HEARTBEAT", "fields": {}}
    lines: list[dict[str, Any]] = [heartbeat, stranger]
    for k in range(flight.n_frames):
        told = []
        if (name, k) not in flight.refused | flight.dropped | flight.held_back:
            told.append((at_ns(n, k), ned_from_body(n, k), flight.error(name, k)))
        if (name, k) in flight.between:
            off = np.array([flight.between[name, k], 0, 0, 0, 0, 0])
            half_ns = at_ns(n, k) + PERIOD_NS // 2
            around = Trajectory.from_poses(
                [at_ns(n, k), at_ns(n, k + 1)], [ned_from_body(n, k), ned_from_body(n, k + 1)]
            )
            halfway = around.pose_at(half_ns)
            assert halfway is not None
            told.append((half_ns, halfway, off))
        for instant, true, error in told:
            truth = NED_FROM_WORLD.inverse() @ true
            x, y, z = truth.translation + error[:3]
            roll, pitch, yaw = np.add(euler_from_matrix(truth.rotation), error[3:])
            fields = {"usec": instant // 1000, "x": x, "y": y, "z": z, "roll": roll,
                      "pitch": pitch, "yaw": yaw, "reset_counter": int(_is_reset(flight, name, k)),
                      "covariance": upper_from_covariance(np.diag(SIGMAS**2)).tolist()}  # fmt: skip
            lines.append({**heartbeat, "type": "VISION_POSITION_ESTIMATE", "fields": fields})
    return lines


def _is_reset(flight: Flight, name: str, k: int) -> bool:
    return flight.reset is not None and flight.reset[0] == name and k >= flight.reset[1]


def _write_lines(path: Path, lines: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
