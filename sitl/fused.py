"""What a real autopilot made of our poses: its own position against the truth, beside ours.

It is judged from two seconds after the first pose, and only where the firmware says that it
has a position by what it is sent. Its local frame is the ``world`` of our poses; where its height
is a barometer's, that counts from elsewhere, and only how it goes is judged.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sitl.autopilots.motion import RecordedMotion
from sitl.evaluation import Estimates, position_rms_m
from sitl.page_style import Column
from sitl.processes import FlightError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import Trajectory

FUSED_FILE, SAID_FILE = "fused.csv", "said.csv"
# EKF_STATUS_FLAGS: a horizontal position, relative or absolute, that is not held for constant.
_POSITION, _CONSTANT_POSITION = 0x8 | 0x10, 0x80
_FLAGS = '"estimator flags '
_SETTLES_NS = 2_000_000_000
FUSED_COLUMNS: tuple[Column, ...] = (
    ("fused_after_s", "fused after s", "{:.2f}", 1.0),
    ("fused_share", "fused %", "{:.1f}", 100.0),
    ("ate_m", "its ATE cm", "{:.2f}", 100.0),
    ("own_ate_m", "ours cm", "{:.2f}", 100.0),
    ("ratio", "ratio", "{:.2f}", 1.0),
    ("ahead_ms", "ahead ms", "{:.0f}", 1.0),
)


@dataclass(frozen=True)
class Fused:
    """One autopilot's own position, over a flight.

    Attributes:
        fused_after_s: from the first pose until it had a position by our poses; None: never.
        fused_share: of the time from the first pose to the end.
        ate_m: root mean square distance of its position from the truth, where fused.
        own_ate_m: the same of our poses as it was sent them.
        ratio: of the two.
        ahead_ms: by how much its position is that of a later instant; negative: of an earlier
            one. It takes our poses for so much older than they are: what the firmware's
            parameter of their delay is too large by.
    """

    fused_after_s: float | None
    fused_share: float
    ate_m: float | None
    own_ate_m: float | None
    ratio: float | None
    ahead_ms: float | None


def read_fused(
    folder: Path,
    sent: Estimates,
    truth: Trajectory | None,
    ref_from_world: Pose | None,
    *,
    has_own_height: bool = False,
    holds_at_rest: bool = False,
) -> Fused | None:
    """Judge what a firmware has written of itself; None where there was none, or no truth.

    Args:
        folder: the drone's, with ``fused.csv`` and ``said.csv``.
        sent: the poses as they were received.
        truth: the recording's.
        ref_from_world: by the leader's start.
        has_own_height: whether its height counts from elsewhere.
        holds_at_rest: whether it calls a position that it has constant while it stands.

    Raises:
        FlightError: a file is broken.
    """
    path = folder / FUSED_FILE
    if not path.exists() or truth is None or ref_from_world is None or not len(sent.at_ns):
        return None
    try:
        at_ns, positions = _read_positions(path)
        spans = _fused_spans(folder / SAID_FILE, 0 if holds_at_rest else _CONSTANT_POSITION)
    except (OSError, ValueError) as broken:
        raise FlightError(f"{path}: {broken}") from broken
    begins_ns, ends_ns = int(sent.at_ns[0]), int(truth.at_ns[-1])
    spans = [(max(a, begins_ns), min(b, ends_ns)) for a, b in spans if b > begins_ns]
    after_s = (spans[0][0] - begins_ns) * 1e-9 if spans else None
    share = sum(max(b - a, 0) for a, b in spans) / max(ends_ns - begins_ns, 1)
    motion = RecordedMotion(truth.at_ns, truth.positions_m, truth.quaternions)

    def judged(times: NDArray[np.int64]) -> NDArray[np.bool_]:
        within = np.any([(times >= a) & (times <= b) for a, b in spans] or [times < 0], axis=0)
        return np.asarray(within & (times >= begins_ns + _SETTLES_NS) & (times <= ends_ns))

    theirs, ours = judged(at_ns), judged(sent.at_ns)
    if not theirs.any() or not ours.any():
        return Fused(after_s, share, None, None, None, None)
    ours_m = np.array([pose.translation for pose in sent.world_from_body])[ours]
    own_error = ref_from_world.apply(ours_m) - motion.at(sent.at_ns[ours]).positions_m
    true = motion.at(at_ns[theirs])
    error = ref_from_world.apply(positions[theirs]) - true.positions_m
    if has_own_height:
        error[:, 2] -= np.median(error[:, 2])
    ate_m, own_ate_m = position_rms_m(error), position_rms_m(own_error)
    speeds = true.velocities_m_s
    moved = float(np.sum(speeds**2))
    ahead_s = float(np.sum(speeds * error)) / moved if moved > 0.0 else None
    return Fused(
        after_s,
        share,
        ate_m,
        own_ate_m,
        ate_m / own_ate_m if own_ate_m > 0.0 else None,
        None if ahead_s is None else ahead_s * 1e3,
    )


def _read_positions(path: Path) -> tuple[NDArray[np.int64], Array]:
    times, rows = [], []
    for line in path.read_text(encoding="utf-8").splitlines()[1:]:
        at_ns, *values = line.split(",")
        times.append(int(at_ns))
        rows.append([float(value) for value in values])
    return np.array(times, dtype=np.int64), np.array(rows, dtype=np.float64).reshape(-1, 3)


def _fused_spans(path: Path, unless: int) -> list[tuple[int, int]]:
    """Return when a firmware said that it had a position, and no flag against it; from, to, ns."""
    spans: list[tuple[int, int]] = []
    since_ns: int | None = None
    for line in path.read_text(encoding="utf-8").splitlines()[1:]:
        at_text, _, text = line.split(",", 2)
        if not text.startswith(_FLAGS):
            continue
        flags = int(text.removeprefix(_FLAGS).rstrip('"'), 16)
        has_it = bool(flags & _POSITION) and not flags & unless
        if has_it and since_ns is None:
            since_ns = int(at_text)
        elif not has_it and since_ns is not None:
            spans.append((since_ns, int(at_text)))
            since_ns = None
    if since_ns is not None:
        spans.append((since_ns, 2**62))
    return spans
