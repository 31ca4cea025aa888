"""What many maps' poses come to: ``consistency.json``, ``consistency.md``, the terminal's table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sitl import evaluation
from sitl.bench.machine import machine
from sitl.consistency.chain import Look
from sitl.default_goals import NEES_MEDIAN
from sitl.report import rounded
from sitl.tables import print_table

# 99.9 % of chi^2 with 6 degrees of freedom.
_FAR = 22.5
_OF_EACH = "of each"
_COLUMNS = ("recording", "instants", "poses", "lost", "NEES", "first map", "later", _OF_EACH,
            "> 22.5 %", "in 3 sigma %", "error cm")  # fmt: skip
_ALONE = ("recording", "poses", "lost", "NEES", "in 3 sigma %", "error cm", "at most")
_HOW = (
    "Maps begun at many instants of each recording and extended from there; poses by their "
    "patches alone, against the truth. *NEES*: median of the normalized squared error of all "
    "poses, 6 degrees of freedom, 5.35 of a normal error; on first maps, on later ones, and of "
    "each beginning, which is one draw of its map's error. *Lost*: frames that patches did not "
    "find. *Error*: median of the position's."
)
_HOW_ALONE = (
    "From where these maps end, each drone by its own last frames alone. *NEES*: median; *error*: "
    "of the position, median and largest."
)


@dataclass(frozen=True, eq=False)
class Beginning:
    """The poses of one chain of maps.

    Attributes:
        begins: index of the leader's frame that it began with.
        looks: all frames looked for.
        ended: why it could not be begun, or not be extended; empty otherwise.
        alone: the frames after its end, by drones' own ones.
    """

    begins: int
    looks: tuple[Look, ...]
    ended: str
    alone: tuple[Look, ...] = ()


def nees_of(look: Look) -> float:
    """Return a pose's normalized squared error; NaN where there is none."""
    if look.fix is None:
        return float("nan")
    return evaluation.nees_of(look.fix.world_from_body.local(look.true), look.fix.covariance())


def recording_report(beginnings: Sequence[Beginning]) -> dict[str, Any]:
    """Return what one recording's poses come to; numbers that there are not are null."""
    looks = [look for beginning in beginnings for look in beginning.looks]
    found = [look for look in looks if look.fix is not None]
    nees = np.array([nees_of(look) for look in found])
    is_first = np.array([look.revision == 0 for look in found], dtype=bool)
    alone = [look for beginning in beginnings for look in beginning.alone]
    report = {
        "instants": len(beginnings),
        **_poses(looks),
        "nees_median_first_map": _median(nees[is_first]),
        "nees_median_later": _median(nees[~is_first]),
        "nees_median_of_each": {
            str(one.begins): _median(np.array([nees_of(k) for k in one.looks if k.fix is not None]))
            for one in beginnings
        },
        "far_share": float(np.mean(nees > _FAR)) if found else None,
        "ended": {str(one.begins): one.ended for one in beginnings if one.ended},
        "own_frames": _poses(alone) | {"position_error_m_most": _most_m(alone)},
    }
    checked = rounded(report)
    assert isinstance(checked, dict)
    return checked


def _poses(looks: Sequence[Look]) -> dict[str, Any]:
    """Return what some poses come to, on maps or by own frames."""
    found = [look for look in looks if look.fix is not None]
    errors = [_position(look) for look in found]
    return {
        "poses": len(found),
        "lost": len(looks) - len(found),
        "nees_median": _median(np.array([nees_of(look) for look in found])),
        "within_3_sigma_share": float(np.mean([e[1] for e in errors])) if found else None,
        "position_error_m_median": _median(np.array([e[0] for e in errors])),
    }


def _most_m(looks: Sequence[Look]) -> float | None:
    return max((_position(look)[0] for look in looks if look.fix is not None), default=None)


def _position(look: Look) -> tuple[float, bool]:
    """Return how far a position is off, m, and whether within 3 sigma along each axis."""
    assert look.fix is not None
    error = look.fix.world_from_body.local(look.true)[:3]
    limit = 3.0 * np.sqrt(np.diag(look.fix.covariance())[:3])
    return float(np.linalg.norm(error)), bool(np.all(np.abs(error) <= limit))


def _median(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.median(values)) if len(values) else None


def write_consistency(out: Path, recordings: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Write ``consistency.json`` and ``consistency.md``; return the former's content."""
    report = {"machine": machine(), "nees_wanted": list(NEES_MEDIAN), "recordings": recordings}
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    (out / "consistency.json").write_text(text + "\n", encoding="utf-8")
    lines = ["# Errors as they are told", "", _HOW, "", *_table(_COLUMNS, _rows(recordings))]
    lines += ["", *(f"* {text}" for text in _ends(recordings))]
    lines += ["", _HOW_ALONE, "", *_table(_ALONE, _rows_alone(recordings))]
    (out / "consistency.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return report


def _table(columns: Sequence[str], rows: list[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    lines = ["| " + " | ".join(columns) + " |", "|---|" + "---:|" * (len(columns) - 1)]
    return lines + ["| " + " | ".join(c.replace("|", "\\|") for c in row) + " |" for row in rows]


def show_consistency(console: Console, report: dict[str, Any], out: Path) -> None:
    """Print the table, and where it is."""
    # A line of a terminal has no room for each beginning.
    shown = [n for n, head in enumerate(_COLUMNS) if head != _OF_EACH]
    rows = _rows(report["recordings"])
    print_table(console, [_COLUMNS[n] for n in shown], [[row[n] for n in shown] for row in rows])
    print_table(console, list(_ALONE), [list(row) for row in _rows_alone(report["recordings"])])
    for text in _ends(report["recordings"]):
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    path = out / "consistency.md"
    console.print(f"report: {path}", markup=False, highlight=False, soft_wrap=True)


def _rows(recordings: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    return [
        (
            name,
            str(of["instants"]),
            str(of["poses"]),
            str(of["lost"]),
            *(_number(of[key]) for key in (
                "nees_median", "nees_median_first_map", "nees_median_later"
            )),
            " ".join(map(_number, of["nees_median_of_each"].values())),
            _number(of["far_share"], 100.0),
            _number(of["within_3_sigma_share"], 100.0),
            _number(of["position_error_m_median"], 100.0),
        )
        for name, of in recordings.items()
    ]  # fmt: skip


def _rows_alone(recordings: dict[str, dict[str, Any]]) -> list[tuple[str, ...]]:
    return [
        (
            name,
            str(of["own_frames"]["poses"]),
            str(of["own_frames"]["lost"]),
            _number(of["own_frames"]["nees_median"]),
            _number(of["own_frames"]["within_3_sigma_share"], 100.0),
            _number(of["own_frames"]["position_error_m_median"], 100.0),
            _number(of["own_frames"]["position_error_m_most"], 100.0),
        )
        for name, of in recordings.items()
    ]


def _ends(recordings: dict[str, dict[str, Any]]) -> list[str]:
    """Return which maps could not be made, and why."""
    return [
        f"{name}, from frame {begins} on: {reason}"
        for name, of in recordings.items()
        for begins, reason in of["ended"].items()
    ]


def _number(value: float | None, factor: float = 1.0) -> str:
    return "" if value is None else f"{factor * value:.1f}"
