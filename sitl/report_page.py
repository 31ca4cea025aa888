"""``report.html``: one file, nothing fetched, the numbers above the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sitl import report_plots
from sitl.result import FlightResult

_MAX_EVENTS = 200
_JUDGED = ("intra", "inter", "sent")

_CSS = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0; background: #f5f7fa; color: #1f2933;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1120px; margin: 0 auto; padding: 40px 24px 64px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 4px; letter-spacing: -0.01em; }
h2 { font-size: 19px; margin: 0 0 10px; }
p.lead { color: #52606d; margin: 0 0 24px; }
p.note { color: #52606d; font-size: 14px; margin: -6px 0 12px; max-width: 78ch; }
section { background: #fff; border: 1px solid #e4e7eb; border-radius: 10px;
  padding: 22px 24px; margin-top: 20px; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(170px, 1fr)); gap: 14px; }
.tile { background: #fff; border: 1px solid #e4e7eb; border-radius: 10px; padding: 14px 18px; }
.tile b { display: block; font-size: 26px; line-height: 1.25; font-weight: 650;
  font-variant-numeric: tabular-nums; }
.tile span { color: #52606d; font-size: 14px; }
.bad { color: #b42318; }
.alarm { border-color: #f3b7b1; background: #fef3f2; }
.alarm ul { margin: 4px 0 0; padding-left: 20px; }
table { border-collapse: collapse; width: 100%; font-size: 14.5px;
  font-variant-numeric: tabular-nums; }
th, td { padding: 7px 10px; text-align: right; border-bottom: 1px solid #e4e7eb;
  white-space: nowrap; }
th { color: #52606d; font-weight: 600; font-size: 13px; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
td.text, th.text { text-align: left; white-space: normal; }
tr:last-child td { border-bottom: 0; }
.swatch { display: inline-block; width: 11px; height: 11px; border-radius: 3px;
  margin-right: 8px; }
.scroll { overflow-x: auto; }
svg[role=img] { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 4px 20px; margin: 0;
  font-size: 14.5px; }
dt { color: #52606d; } dd { margin: 0; overflow-wrap: anywhere; }
"""

_COLUMNS = (
    ("frames", "frames", "{:d}", 1.0),
    ("localized_share", "localized %", "{:.1f}", 100.0),
    ("frames_refused", "refused", "{:d}", 1.0),
    ("frames_dropped", "dropped", "{:d}", 1.0),
    ("ate_m", "ATE cm", "{:.1f}", 100.0),
    ("ate_aligned_m", "aligned cm", "{:.1f}", 100.0),
    ("worst_m", "worst cm", "{:.1f}", 100.0),
    ("yaw_rmse_deg", "yaw RMSE °", "{:.2f}", 1.0),
    ("within_3_sigma_share", "in 3σ %", "{:.1f}", 100.0),
    ("nees_median", "NEES", "{:.1f}", 1.0),
    ("landmarks", "landmarks", "{:.0f}", 1.0),
)
_LOAD_COLUMNS = (
    ("cpu_share", "CPU % of a core", "{:.0f}", 100.0),
    ("resident_mb", "memory MB", "{:.0f}", 1.0),
    ("peer_bytes_per_s", "to peers kB/s", "{:.1f}", 1e-3),
    ("first_frame_ms", "first frame ms", "{:.0f}", 1.0),
)


def page(result: FlightResult, report: Mapping[str, Any]) -> str:
    """Return the whole page of a flight; ``report`` is what ``report.json`` says."""
    name = escape(str(report["recording"]))
    errors = report_plots.errors_svg(result)
    sections = [
        _alarms(report),
        _section("Where they flew", _flight_note(result), report_plots.trajectories_svg(result)),
        _section("How well", _SCORE_NOTE, _score_table(report)),
        _section("Whence the poses", _SOURCE_NOTE, _source_table(report)),
        _section("Error along every axis", _ERROR_NOTE, errors) if errors else "",
        _section("Tracked landmarks", "", report_plots.landmarks_svg(result)),
        _section("Latency and load", _LATENCY_NOTE,
                 report_plots.latency_svg(result) + _load_table(report)),
        _refusals(report),
        _events(report),
        _section("How it was flown", "", _options(report)),
    ]  # fmt: skip
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{name} · flight report</title>\n<style>{_CSS}</style>\n</head>\n<body>\n<main>\n"
        f"<h1>{name}</h1>\n<p class=lead>{_lead(report)}</p>\n{_tiles(report)}\n"
        + "\n".join(filter(None, sections))
        + "\n</main>\n</body>\n</html>\n"
    )


_SCORE_NOTE = (
    "ATE: root mean square distance from the truth, with no alignment but the leader's start; "
    "“aligned” after the best rotation and shift of each drone's own track. In 3σ: poses whose "
    "error stays within three of their own sigmas along each axis. NEES: median, 5.3 when the "
    "covariance is honest, more when it promises too much."
)
_SOURCE_NOTE = (
    "Share of the frames whose pose came from the frame's own landmarks (intra), from a peer that "
    "saw the same (inter), or from both. NEES and ATE of each by itself, before it was fused, "
    "beside what was sent."
)
_ERROR_NOTE = (
    "Along the recording's axes; the band is three sigmas as sent, a red ring a pose outside it. "
    "The leader's first pose is zero by construction: the alignment rests on it."
)
_LATENCY_NOTE = (
    "From a frame's arrival in the daemon to its outcome, of the frames that were looked at. The "
    "first frame waits for the first map and is told apart."
)


def _lead(report: Mapping[str, Any]) -> str:
    drones, options = report["drones"], report["options"]
    pace = "as fast as all keep up" if options["speed"] == "max" else f"speed {options['speed']:g}"
    frames = sum(drone["frames"] for drone in drones.values())
    count = f"{len(drones)} drone{'s' if len(drones) > 1 else ''}"
    return f"{count}, {frames} frames in {report['duration_s']:.1f} s of flight, {pace}"


def _tiles(report: Mapping[str, Any]) -> str:
    drones = list(report["drones"].values())
    frames = sum(drone["frames"] for drone in drones)
    localized = sum(drone["localized_share"] * drone["frames"] for drone in drones)
    ates = [drone["ate_m"] for drone in drones if drone["ate_m"] is not None]
    p99s = [d["latency_ms"]["p99"] for d in drones if d["latency_ms"]["p99"] is not None]
    unaccounted = sum(drone["unaccounted"] for drone in drones)
    tiles = [
        (f"{100.0 * localized / frames:.1f} %", "of frames localized", False),
        (f"{100.0 * max(ates):.1f} cm" if ates else "—", "worst drone's ATE", False),
        (f"{max(p99s):.0f} ms" if p99s else "—", "p99 latency", False),
        (f"{report['map']['landmarks']}", f"landmarks, {report['map']['bytes'] / 1e3:.0f} kB map",
         False),
        (f"{unaccounted}", "frames unaccounted for", unaccounted > 0),
    ]  # fmt: skip
    cells = (
        f"<div class=tile><b{' class=bad' if bad else ''}>{value}</b><span>{label}</span></div>"
        for value, label, bad in tiles
    )
    return f"<div class=tiles>{''.join(cells)}</div>"


def _alarms(report: Mapping[str, Any]) -> str:
    """Say what does not add up where nobody can miss it."""
    lines = [
        f"<li>{escape(event['drone'])}: {escape(event['reason'])}</li>"
        for event in report["events"]
        if event["kind"] == "harness"
    ]
    if not lines:
        return ""
    return f"<section class=alarm><h2>Look at this first</h2><ul>{''.join(lines)}</ul></section>"


def _flight_note(result: FlightResult) -> str:
    if result.ref_from_world is None:
        return "No truth to compare with: in the swarm's own frame, the leader's start its origin."
    return (
        "Dashed: truth. A ring marks each drone's first pose. To scale; the one alignment is the "
        f"first pose of {escape(result.plan.leader)}."
    )


def _score_table(report: Mapping[str, Any]) -> str:
    return _drone_table(report, _COLUMNS, ())


def _source_table(report: Mapping[str, Any]) -> str:
    heads = [
        *("intra %", "inter %", "fused %", "proposals", "taken"),
        *(f"{what} {s}" for what in ("NEES", "ATE cm") for s in _JUDGED),
    ]
    rows = []
    for n, (name, drone) in enumerate(report["drones"].items()):
        said = drone["sources"]
        cells = [_number(said["share"][s], "{:.1f}", 100.0) for s in ("intra", "inter", "fused")]
        cells += [_number(said[key], "{:d}", 1.0) for key in ("proposals", "proposals_fused")]
        cells += [_number(said["nees_median"][s], "{:.1f}", 1.0) for s in _JUDGED]
        cells += [_number(said["ate_m"][s], "{:.1f}", 100.0) for s in _JUDGED]
        rows.append(_row(n, name, cells))
    return _table(heads, rows)


def _load_table(report: Mapping[str, Any]) -> str:
    return _drone_table(report, _LOAD_COLUMNS, ("p50", "p99"))


def _drone_table(
    report: Mapping[str, Any],
    columns: Sequence[tuple[str, str, str, float]],
    percentiles: Sequence[str],
) -> str:
    heads = [f"{p} ms" for p in percentiles] + [label for _, label, _, _ in columns]
    rows = []
    for n, (name, drone) in enumerate(report["drones"].items()):
        cells = [_number(drone["latency_ms"][p], "{:.1f}", 1.0) for p in percentiles]
        cells += [_number(drone[key], form, scale) for key, _, form, scale in columns]
        rows.append(_row(n, name, cells))
    return _table(heads, rows)


def _row(n: int, drone: str, cells: Sequence[str]) -> str:
    swatch = f'<span class=swatch style="background:{report_plots.colour(n)}"></span>'
    return f"<tr><td>{swatch}{escape(drone)}</td>{''.join(f'<td>{c}</td>' for c in cells)}</tr>"


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{escape(label)}</th>" for label in ["drone", *heads])
    return f"<div class=scroll><table><tr>{head}</tr>{''.join(rows)}</table></div>"


def _number(value: float | None, form: str, scale: float) -> str:
    if value is None:
        return "—"
    return form.format(int(value * scale) if form == "{:d}" else value * scale)


def _refusals(report: Mapping[str, Any]) -> str:
    rows = [
        f"<tr><td>{escape(name)}</td><td>{count}</td><td class=text>{escape(reason)}</td></tr>"
        for name, drone in report["drones"].items()
        for reason, count in drone["refusals"].items()
    ]
    if not rows:
        return ""
    head = "<tr><th>drone</th><th>frames</th><th class=text>reason</th></tr>"
    return _section("Refused frames", "", f"<table>{head}{''.join(rows)}</table>")


def _events(report: Mapping[str, Any]) -> str:
    events = report["events"]
    rows = [
        f"<tr><td>{event['at_s']:.2f}</td><td class=text>{escape(event['drone'])}</td>"
        f"<td class=text>{escape(event['kind'])}</td>"
        f"<td class=text>{escape(event['reason'])}</td></tr>"
        for event in events[:_MAX_EVENTS]
    ]
    if not rows:
        return ""
    left_out = len(events) - len(rows)
    note = f"The first {_MAX_EVENTS}; {left_out} more are in report.json." if left_out else ""
    head = (
        "<tr><th>time s</th><th class=text>drone</th><th class=text>what</th>"
        "<th class=text>why</th></tr>"
    )
    return _section("Events", note, f"<table>{head}{''.join(rows)}</table>")


def _options(report: Mapping[str, Any]) -> str:
    options, wall, swarm_map = report["options"], report.get("wall", {}), report["map"]
    distances = ", ".join(f"{k} {v:.3f} m" for k, v in options["known_distances_m"].items())
    settings = ", ".join(f"{key} = {value}" for key, value in options["settings"].items())
    rows = [
        ("leader", options["leader"]),
        ("known distance", distances or "none"),
        ("attitude", f"{options['attitude']}, seed {options['seed']}"),
        ("pipeline", report["pipeline"]),
        ("settings", settings or "defaults"),
        ("map revisions", f"{swarm_map['revisions']} ({swarm_map['keyframes']} keyframes)"),
    ]
    if wall:
        late = wall["late_p99_ms"]
        rows.append(("wall time", f"{wall['start_s']:.1f} s to the first map, then "
                     f"{wall['flight_s']:.1f} s" + (f"; frames handed out {late:.1f} ms late (p99)"
                     if late is not None else "")))  # fmt: skip
    return "<dl>" + "".join(f"<dt>{k}</dt><dd>{escape(str(v))}</dd>" for k, v in rows) + "</dl>"


def _section(title: str, note: str, content: str) -> str:
    noted = f"<p class=note>{note}</p>" if note else ""
    return f"<section>\n<h2>{title}</h2>{noted}{content}\n</section>"
