"""A flight's output folder: made, and on the next flight cleared of what flights write."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sitl.fused import FUSED_FILE, SAID_FILE
from sitl.mission import COMMANDED_FILE
from sitl.plan import FlightPlan
from sitl.processes import FlightError
from vcl_companion.errors import ConfigError, reason_of

RECORDING_FOLDER = "recording"
"""What a live flight has recorded."""

_MARK = Path("run") / "flight.json"
_OWN_FILES = (
    *("estimate.tum", "covariance.csv", "truth.tum", "received.jsonl", "attitude.csv"),
    "global.csv",
    *(FUSED_FILE, SAID_FILE, COMMANDED_FILE),
)
_OWN_REPORTS = ("report.json", "report.html")
_OWN_FOLDERS = ("run", RECORDING_FOLDER)


@contextmanager
def files_in_one_line() -> Iterator[None]:
    """Say what is wrong with a file of a flight in one line: a full disk, an image that is gone.

    Raises:
        FlightError: instead of any OSError.
    """
    try:
        yield
    except OSError as error:
        which = f"{error.filename}: " if error.filename else ""
        raise FlightError(f"{which}{reason_of(error) or type(error).__name__}") from error


def prepare_folder(out: Path, plan: FlightPlan, *, records: bool = False) -> None:
    """Make the output folder, without what an earlier flight left in it.

    Args:
        out: the folder.
        plan: of the flight.
        records: whether its recording is made in flight, in that folder.

    Raises:
        ConfigError: it holds something else, or cannot be written.
    """
    earlier = plan.options.attitude
    try:
        if earlier is not None and out.resolve() == earlier.resolve():
            raise ConfigError(f"--out and --attitude are the same folder, {out}")
        flown = plan.recording.path.resolve()
        removed = [(out / name).resolve() for name in _OWN_FOLDERS]
        if not records and any(flown.is_relative_to(folder) for folder in removed):
            raise ConfigError(f"{out}: holds the recording to be flown; give another folder")
        if out.exists() and not out.is_dir():
            raise ConfigError(f"{out}: is a file; give a folder")
        if out.is_dir() and any(out.iterdir()) and not (out / _MARK).is_file():
            raise ConfigError(f"{out}: holds something other than a flight; give another folder")
        _remove_earlier(out)
        for drone in plan.drones:
            (out / drone.name).mkdir(parents=True, exist_ok=True)
            (out / "run" / drone.name / "maps").mkdir(parents=True)
        marks = {"recording": str(plan.recording.path.resolve())}
        (out / _MARK).write_text(json.dumps(marks) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror})") from error


def _remove_earlier(out: Path) -> None:
    """Remove what flights write, by name; never a file that is not theirs."""
    for folder in out.glob("mav*"):
        for name in _OWN_FILES:
            (folder / name).unlink(missing_ok=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
    for name in _OWN_REPORTS:
        (out / name).unlink(missing_ok=True)
    for name in _OWN_FOLDERS:
        if (out / name).is_dir():
            shutil.rmtree(out / name)
