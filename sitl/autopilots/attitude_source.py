"""What a stand-in autopilot believes its attitude to be: truth with errors, or a recorded stream.

Files are CSV with one header line. A trajectory has ``at_ns,x,y,z,qw,qx,qy,qz``
(the quaternion is ned_from_body), a recorded stream ``at_ns,qw,qx,qy,qz``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import ConfigError
from vcl_companion.geometry.rotation import (
    Array,
    exp_so3,
    log_so3,
    matrix_from_quaternion,
    quaternion_from_matrix,
)


class AttitudeSource(Protocol):
    """Attitudes by recording time."""

    def between(self, after_ns: int | None, until_ns: int) -> list[tuple[int, Array]]:
        """Return (at_ns, (4,) quaternion w x y z) of each sample in (after_ns, until_ns].

        ``after_ns`` None asks for the first time: then only what is newest at ``until_ns``.
        """
        ...


@dataclass(frozen=True)
class AttitudeErrors:
    """One-sigma errors of an autopilot's attitude.

    Attributes:
        tilt_bias_deg: constant, about the north and the east axis each.
        heading_bias_deg: constant, about the down axis.
        white_deg: new with every sample, about each body axis.
    """

    tilt_bias_deg: float = 0.3
    heading_bias_deg: float = 2.0
    white_deg: float = 0.1


class TruthAttitude:
    """Attitude of a trajectory, interpolated on the arc, with stated errors.

    Samples stand every period from the first instant asked for, and at each
    ``until_ns`` itself, which is how a frame's instant gets a sample of its own.
    An instant's error depends on the seed and the instant only, not on the
    steps in which time was advanced.
    """

    def __init__(self, path: Path, rate_hz: float, errors: AttitudeErrors, seed: int) -> None:
        table = read_table(path, 8)
        self._at_ns = table[0]
        self._rotations = [matrix_from_quaternion(q) for q in table[1][:, 3:7]]
        self._period_ns = round(1e9 / rate_hz)
        self._white_rad = np.deg2rad(errors.white_deg)
        self._seed = seed
        sigmas_deg = [errors.tilt_bias_deg, errors.tilt_bias_deg, errors.heading_bias_deg]
        self._bias = exp_so3(np.random.default_rng(seed).normal(0.0, np.deg2rad(sigmas_deg)))
        self._origin_ns: int | None = None

    def between(self, after_ns: int | None, until_ns: int) -> list[tuple[int, Array]]:
        """Return the samples due (see ``AttitudeSource``)."""
        if self._origin_ns is None or after_ns is None:
            self._origin_ns = until_ns
            return [(until_ns, self._measured(until_ns))]
        first = (after_ns - self._origin_ns) // self._period_ns + 1
        last = (until_ns - self._origin_ns) // self._period_ns
        grid = [self._origin_ns + k * self._period_ns for k in range(first, last + 1)]
        if not grid or grid[-1] != until_ns:
            grid.append(until_ns)
        return [(at_ns, self._measured(at_ns)) for at_ns in grid]

    def _measured(self, at_ns: int) -> Array:
        rng = np.random.default_rng([self._seed, at_ns])
        white = exp_so3(rng.normal(0.0, self._white_rad, 3))
        return quaternion_from_matrix(self._bias @ self._true(at_ns) @ white)

    def _true(self, at_ns: int) -> Array:
        after = int(np.searchsorted(self._at_ns, at_ns))
        if after == 0:
            return self._rotations[0]
        if after == len(self._at_ns):
            return self._rotations[-1]
        before_ns, after_ns = int(self._at_ns[after - 1]), int(self._at_ns[after])
        fraction = (at_ns - before_ns) / (after_ns - before_ns)
        start, end = self._rotations[after - 1], self._rotations[after]
        return np.asarray(start @ exp_so3(fraction * log_so3(start.T @ end)))


class ReplayedAttitude:
    """The samples of an earlier flight, unchanged."""

    def __init__(self, path: Path) -> None:
        self._at_ns, self._quaternions = read_table(path, 5)

    def between(self, after_ns: int | None, until_ns: int) -> list[tuple[int, Array]]:
        """Return the samples due (see ``AttitudeSource``)."""
        last = int(np.searchsorted(self._at_ns, until_ns, side="right"))
        if after_ns is None:
            first = max(0, last - 1)
        else:
            first = int(np.searchsorted(self._at_ns, after_ns, side="right"))
        return [(int(self._at_ns[i]), self._quaternions[i]) for i in range(first, last)]


def read_table(path: Path, n_columns: int) -> tuple[NDArray[np.int64], Array]:
    """Return (T,) rising instants, ns, and the (T, n_columns - 1) other columns of a CSV file.

    Raises:
        ConfigError: the file cannot be read or a row is wrong; names file and row.
    """
    times: list[int] = []
    rows: list[list[float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    for number, line in enumerate(lines[1:], start=2):
        cells = line.split(",")
        try:
            at_ns, row = int(cells[0]), [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise ConfigError(f"{path}, row {number}: {error}") from error
        if len(cells) != n_columns or not np.all(np.isfinite(row)):
            raise ConfigError(f"{path}, row {number}: expected {n_columns} finite numbers")
        if abs(float(np.linalg.norm(row[-4:])) - 1.0) > 1e-3:
            raise ConfigError(f"{path}, row {number}: not a unit quaternion")
        if not 0 <= at_ns < 2**63:
            raise ConfigError(f"{path}, row {number}: {at_ns} is no time in nanoseconds")
        if times and at_ns <= times[-1]:
            raise ConfigError(f"{path}, row {number}: time does not rise")
        times.append(at_ns)
        rows.append(row)
    if not rows:
        raise ConfigError(f"{path}: has no rows")
    return np.array(times, dtype=np.int64), np.array(rows)
