"""``report.html``: one file, nothing fetched, the numbers above the pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from sitl import report_plots
from sitl.flown_mission import MISSION_COLUMNS
from sitl.fused import FUSED_COLUMNS
from sitl.lives_report import lives_html
from sitl.network_report import network_html, network_text
from sitl.page_style import document, drones_table, section
from sitl.phases import phases_html
from sitl.plotting import colour
from sitl.reliance import RELIANCES, strips_svg
from sitl.result import FlightResult

_MAX_EVENTS = 200
_JUDGED = ("intra", "inter", "sent")

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
    network, lives, phases = network_html(report), lives_html(report), phases_html(report)
    fused = drones_table(report, "fused", FUSED_COLUMNS)
    missions = drones_table(report, "mission", MISSION_COLUMNS)
    parts = [
        _alarms(report),
        section("Where they flew", _flight_note(result), report_plots.trajectories_svg(result)),
        section("Missions", _MISSION_NOTE, missions) if missions else "",
        section("How well", _SCORE_NOTE, _score_table(report)),
        section("What the poses rely on", _RELIANCE_NOTE,
                 strips_svg(result) + _reliance_table(report)),
        section("Whence the poses", _SOURCE_NOTE, _source_table(report)),
        section("What the autopilots made of it", _FUSED_NOTE, fused) if fused else "",
        section("Lives of the daemons", _LIVES_NOTE, lives) if lives else "",
        section("Apart and together", _PHASES_NOTE, phases) if phases else "",
        section("Error along every axis", _ERROR_NOTE, errors) if errors else "",
        section("Tracked landmarks", "", report_plots.landmarks_svg(result)),
        section("Latency and load", _LATENCY_NOTE,
                 report_plots.latency_svg(result) + _load_table(report)),
        section("Between the drones", _NETWORK_NOTE, network) if network else "",
        _refusals(report),
        _events(report),
        section("How it was flown", "", _options(report)),
    ]  # fmt: skip
    return document(f"{name} · flight report", name, _lead(report), [_tiles(report), *parts])


_SCORE_NOTE = (
    "ATE: root mean square distance from the truth, with no alignment but the leader's start; "
    "“aligned” after the best rotation and shift of each drone's own track. In 3σ: poses whose "
    "error stays within three of their own sigmas along each axis. NEES: median, 5.3 when the "
    "covariance is honest, more when it promises too much."
)
_MISSION_NOTE = (
    "Off its way: how far the truth was from the commanded path, at most and on average, from "
    "arming to disarming. Its commands are places in our map; the leader's start carries them to "
    "the truth."
)
_RELIANCE_NOTE = (
    "Of each frame: the map, recognised by its patches or, at the start and when lost, by "
    "features; a peer that told where we were; attitude and motion since the last of these, where "
    "filter.coast_s allows it (such a frame counts as refused); or nothing. A tick: a peer's word "
    "was fused as well. Share of the frames in the table. Poses between frames are of where the "
    "last velocity and the autopilot's attitude put the drone; no other number is of them."
)
_SOURCE_NOTE = (
    "Share of the frames whose pose came from the frame's own landmarks (intra), from a peer that "
    "saw the same (inter), or from both. NEES and ATE of each by itself, before it was fused, "
    "beside what was sent."
)
_PHASES_NOTE = (
    "While some could not hear others, before that and after. Resets: announced to the autopilot "
    "by reset_counter. Largest step: by how much the error of what it was told changed at most "
    "from one frame to the next without such an announcement."
)
_ERROR_NOTE = (
    "Along the recording's axes; the band is three sigmas as sent, a red ring a pose outside it. "
    "The leader's first pose is zero by construction: the alignment rests on it."
)
_LATENCY_NOTE = (
    "From a frame's arrival in the daemon to its outcome, of the frames that were looked at. The "
    "first frame of who is there from the start waits for the first map and is told apart."
)

_FUSED_NOTE = (
    "The firmware's own position (ArduPilot's LOCAL_POSITION_NED, PX4's ODOMETRY) against the "
    "truth, from two seconds after the first pose and where its estimator says that it has one; "
    "ours beside it, as it was sent. Of a height that is a barometer's (a PX4's that flies by "
    "itself) it is how it goes that is judged: it counts from where the drone was switched on. "
    "Ahead: its position is that of so much later an instant, as it takes our poses for so much "
    "older than they are; the firmware's parameter of their delay is too large by that."
)
_LIVES_NOTE = (
    "Seconds of the recording at which a daemon was started, was ready (had connected to its "
    "camera) and was killed. From ready, in seconds of the wall clock: to its first map, to one "
    "that another flew on as well, and to the first pose that its autopilot got. Frames count "
    "for a drone while its daemon lived."
)
_NETWORK_NOTE = (
    "What each drone sent to the others, what all hear once, with --addressed once for each of "
    "them: the payload of TUNNEL, the whole MAVLink frames, and the frames by drone in kB, from "
    "the start of the daemons to their end; B/s per second of the recording. Below what became "
    "of the datagrams, by sender, and the delay that the network gave them."
)


def _lead(report: Mapping[str, Any]) -> str:
    drones, options = report["drones"], report["options"]
    pace = (
        "as fast as all keep up, maps included"
        if options["speed"] == "max"
        else f"speed {options['speed']:g}"
    )
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
        (f"{100.0 * localized / frames:.1f} %" if frames else "—", "of frames localized", False),
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


def _reliance_table(report: Mapping[str, Any]) -> str:
    heads = [
        f'{label} % <span class=swatch style="background:{ink}"></span>'
        for label, ink in RELIANCES.values()
    ]
    heads += ["between frames", "their ATE cm"]
    rows = []
    for n, (name, drone) in enumerate(report["drones"].items()):
        said, between = drone["relies_on"], drone["between"]
        cells = [_number(said[k], "{:.1f}", 100.0) for k in RELIANCES]
        cells.append(_number(between["poses"], "{:d}", 1.0))
        cells.append(_number(between["ate_m"], "{:.1f}", 100.0))
        rows.append(_row(n, name, cells))
    return _table(heads, rows)


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
    swatch = f'<span class=swatch style="background:{colour(n)}"></span>'
    return f"<tr><td>{swatch}{escape(drone)}</td>{''.join(f'<td>{c}</td>' for c in cells)}</tr>"


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{label}</th>" for label in ["drone", *heads])
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
    return section("Refused frames", "", f"<table>{head}{''.join(rows)}</table>")


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
    return section("Events", note, f"<table>{head}{''.join(rows)}</table>")


def _options(report: Mapping[str, Any]) -> str:
    options, wall, swarm_map = report["options"], report.get("wall", {}), report["map"]
    distances = ", ".join(f"{k} {v:.3f} m" for k, v in options["known_distances_m"].items())
    settings = ", ".join(f"{key} = {value}" for key, value in options["settings"].items())
    rows = [
        ("leader", options["leader"]),
        ("known distance", distances or "none"),
        ("attitude", f"{options['attitude']}, seed {options['seed']}"),
        ("network", network_text(options["network"])),
        ("pipeline", report["pipeline"]),
        ("settings", settings or "defaults"),
        ("absences", ", ".join(options["absences"]) or "none"),
        ("dead cameras", ", ".join(options["blind"]) or "none"),
        ("map revisions", f"{swarm_map['revisions']} ({swarm_map['keyframes']} keyframes)"),
    ]
    if wall:
        late = wall["late_p99_ms"]
        rows.append(("wall time", f"{wall['start_s']:.1f} s to the first map, then "
                     f"{wall['flight_s']:.1f} s" + (f"; frames handed out {late:.1f} ms late (p99)"
                     if late is not None else "")))  # fmt: skip
    return "<dl>" + "".join(f"<dt>{k}</dt><dd>{escape(str(v))}</dd>" for k, v in rows) + "</dl>"
