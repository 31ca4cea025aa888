"""``paper.html``: the experiments beside the paper's figures; one file, nothing fetched."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

from sitl import paper_figures, paper_flight_figures
from sitl.goals import Goal
from sitl.page_style import document, section
from sitl.paper_experiments import TABLE_I, AxisErrors, Pipeline
from sitl.paper_flights import PaperFlight
from sitl.paper_goals import NEES_MEDIAN, WORSE_AT_MOST

if TYPE_CHECKING:
    from sitl.paper import PaperResult

_NO_SOURCES = (
    " <strong>These flights' logs do not say what the estimates come from, so sources and "
    "proposals are missing here.</strong>"
)
_HOW = (
    "Errors are what each autopilot received minus the truth, along the recording's axes. The "
    "daemons' world is laid onto the recording by <strong>one</strong> rigid transform for the "
    "whole swarm: the leader's true pose against its own first estimate; nothing is fitted, "
    "neither a drone's track nor the scale. Frames without a pose count in the share localized, "
    "not in the errors. The images are rendered, the daemons, sockets and MAVLink are real."
)
_AXES = (
    "<strong>X</strong> is depth: north, the way the drones look and fly, to and from the façade. "
    "<strong>Y</strong> is lateral: east, along the façade. <strong>Z</strong> is vertical: down. "
    "The paper's figures are taken along the same axes (forward, right, down), an assumption: far "
    "from a façade, sideways and yaw are hardest to tell apart, and its Y carries nearly all of "
    "its error. The 3-D column does not depend on it."
)
_GOALS_NOTE = (
    "Judged on whole flights only. The agreement with other implementations is tested by "
    "<code>make test</code>; the benchmarks are <code>python -m sitl bench</code>."
)
_COMPARED_NOTE = (
    "3-D RMSE, and the ratio of fused to unfused over the frames that <em>both</em> flights "
    "localized: a flight that refuses the hard frames would win otherwise. Above "
    "1.05 fusion did harm."
)
_NEES_NOTE = (
    "Medians, 6 degrees of freedom: 5.3 when the covariance is honest, more when it promises too "
    "much; 2 to 12 is asked. Intra: a frame's own fix; inter: proposals of peers that went in, "
    "and in brackets those that were refused; sent: what the filter made of them. The leader's "
    "own is low by construction, the alignment rests on its first pose."
)


def page(result: PaperResult, pipelines: Sequence[Pipeline], paper: Mapping[str, Any]) -> str:
    """Return the whole page; ``paper`` is what ``paper.json`` says."""
    parts = [_alarms(result), _must_show(result, pipelines), _table_1(pipelines, paper)]
    parts += [_overview(pipelines, paper), _nees(pipelines, paper)]
    for pipeline in pipelines:
        flights = result.flights.get(pipeline.name, {})
        of = f", {escape(pipeline.title)}" if len(pipelines) > 1 else ""
        parts += _figures(result, flights, of)
    parts.append(section("How it was flown", _HOW, _how(result, paper)))
    lead = f"{sum(map(len, result.flights.values()))} flights"
    if not result.whole:
        lead += "; only the beginning of each scenario, so nothing is judged"
    title = "The paper's experiments"
    return document(f"{title} · VCL companion", title, lead, parts)


def _alarms(result: PaperResult) -> str:
    lines = [f"{escape(flight)}: {escape(why)}" for flight, why in result.failures]
    for flights in result.flights.values():
        for (name, _), flight in flights.items():
            lines += [
                f"{escape(name)}, {flight.variant}: {escape(event['drone'])}: "
                f"{escape(event['reason'])}"
                for event in flight.report["events"]
                if event["kind"] == "harness"
            ]
    if not lines:
        return ""
    items = "".join(f"<li>{line}</li>" for line in lines)
    return f"<section class=alarm><h2>Look at this first</h2><ul>{items}</ul></section>"


def _must_show(result: PaperResult, pipelines: Sequence[Pipeline]) -> str:
    """Return a table a pipeline: what one has to show another may not."""
    parts = []
    for pipeline in pipelines:
        rows = "".join(
            f"<tr><td>{escape(g.experiment or 'all')}</td><td class=text>{escape(g.what)}</td>"
            f"<td class=text>{escape(g.goal)}</td><td class=text>{escape(g.measured)}</td>"
            f"{_verdict(g)}</tr>"
            for g in result.goals[pipeline.name]
        )
        heads = "".join(f"<th class=text>{h}</th>" for h in ("shows", "goal", "measured", ""))
        table = f"<div class=scroll><table><tr><th>flight</th>{heads}</tr>{rows}</table></div>"
        of = f", {escape(pipeline.title)}" if len(pipelines) > 1 else ""
        parts.append(section(f"What it must show{of}", _GOALS_NOTE, table))
    return "".join(parts)


def _verdict(goal: Goal) -> str:
    mark = {"met": "✓ met", "not met": "✗ not met"}.get(goal.verdict, goal.verdict)
    bad = ' style="white-space:nowrap"'
    inner = f"<span class=bad>{mark}</span>" if goal.verdict == "not met" else mark
    return f"<td class=text{bad}>{inner}</td>"


def _table_1(pipelines: Sequence[Pipeline], paper: Mapping[str, Any]) -> str:
    heads = ["MAV", "axis", "paper", *(escape(pipeline.title) for pipeline in pipelines)]
    if len(pipelines) == 1:
        heads[-1] = "ours"
    rows = []
    for name, theirs in TABLE_I.items():
        for n, axis in enumerate(("X", "Y", "Z", "3-D")):
            cells = [_of_paper(theirs, n)]
            for pipeline in pipelines:
                flights = paper["pipelines"][pipeline.name]["experiments"].get("forward_back")
                cells.append(_of_ours(flights, name, n))
            mav = f"MAV {name.removeprefix('mav')}" if n == 0 else ""
            strong = ("<strong>", "</strong>") if n == 3 else ("", "")
            told = "".join(f"<td>{strong[0]}{cell}{strong[1]}</td>" for cell in cells)
            rows.append(f"<tr><td>{mav}</td><td>{axis}</td>{told}</tr>")
    table = _table(heads, rows)
    note = (
        "RMS error of the forward and backward flight in cm, fused and in brackets unfused. "
        + _AXES
    )
    return section("Table I", note, table)


def _of_paper(theirs: AxisErrors, axis: int) -> str:
    if axis < 3:
        return f"{theirs.fused_cm[axis]:.1f} ({theirs.unfused_cm[axis]:.1f})"
    return f"{math.hypot(*theirs.fused_cm):.1f} ({math.hypot(*theirs.unfused_cm):.1f})"


def _of_ours(flights: Mapping[str, Any] | None, name: str, axis: int) -> str:
    values = []
    for variant in ("fused", "unfused"):
        drone = ((flights or {}).get(variant) or {"drones": {}})["drones"].get(name)
        if drone is None or drone["rmse_cm"] is None:
            values.append("—")
        else:
            value = drone["rmse_3d_cm"] if axis == 3 else drone["rmse_cm"]["xyz"[axis]]
            values.append(f"{value:.1f}")
    return f"{values[0]} ({values[1]})"


def _overview(pipelines: Sequence[Pipeline], paper: Mapping[str, Any]) -> str:
    heads = ["flight", "drone", "localized %", "3-D RMSE cm", "worst cm", "yaw RMSE °",
             "in 3σ %", "ratio, common frames"]  # fmt: skip
    rows = []
    for pipeline in pipelines:
        of = f"{escape(pipeline.title)}: " if len(pipelines) > 1 else ""
        for name, told in paper["pipelines"][pipeline.name]["experiments"].items():
            rows += _overview_rows(f"{of}{escape(name)}", told)
    note = "Fused, and in brackets unfused. " + _COMPARED_NOTE
    return section("All flights", note, _table(heads, rows))


def _overview_rows(label: str, told: Mapping[str, Any]) -> list[str]:
    variants = [told[v] for v in ("fused", "unfused")]
    drones = next((list(v["drones"]) for v in variants if v), [])
    rows = []
    for n, drone in enumerate(drones):
        both = [v["drones"][drone] if v else None for v in variants]
        compared = (told["fused_against_unfused"] or {}).get(drone) or {}
        ratio = compared.get("ratio")
        cells = [
            _pair(both, "localized_share", "{:.1f}", 100.0),
            _pair(both, "rmse_3d_cm", "{:.1f}"),
            _pair(both, "worst_cm", "{:.1f}"),
            _pair(both, "yaw_rmse_deg", "{:.2f}"),
            _pair(both, "within_3_sigma_share", "{:.1f}", 100.0),
            "—" if ratio is None else f"{ratio:.2f} of {compared['frames']}",
        ]
        if ratio is not None and ratio > WORSE_AT_MOST:
            cells[-1] = f"<span class=bad>{cells[-1]}</span>"
        told_cells = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(
            f"<tr><td>{label if n == 0 else ''}</td><td>{escape(drone)}</td>{told_cells}</tr>"
        )
    return rows


def _pair(both: Sequence[Mapping[str, Any] | None], key: str, form: str, scale: float = 1.0) -> str:
    fused, unfused = (
        form.format(d[key] * scale) if d is not None and d[key] is not None else "—" for d in both
    )
    return fused if both[1] is None else f"{fused} ({unfused})"


def _nees(pipelines: Sequence[Pipeline], paper: Mapping[str, Any]) -> str:
    heads = ["flight", "drone", "intra", "inter (refused)", "sent, fused", "sent, unfused",
             "proposals (refused)"]  # fmt: skip
    rows = []
    for pipeline in pipelines:
        for name, told in paper["pipelines"][pipeline.name]["experiments"].items():
            if told["fused"] is None:
                continue
            for n, (drone, measured) in enumerate(told["fused"]["drones"].items()):
                nees = measured["nees_median"]
                other = told["unfused"]["drones"][drone]["nees_median"] if told["unfused"] else {}
                counts = measured["estimates"]
                leads = drone == told["fused"]["leader"]
                judged = _plain if leads else _judged
                came = f"{counts['inter']} ({counts['inter_refused']})" if counts else "—"
                cells = [
                    judged(nees["intra"]),
                    f"{judged(nees['inter'])} ({_plain(nees['inter_refused'])})",
                    judged(nees["sent"]),
                    _plain(other.get("sent")),
                    came,
                ]
                told_cells = "".join(f"<td>{cell}</td>" for cell in cells)
                label = escape(name) if n == 0 else ""
                who = escape(drone) + (", leader" if leads else "")
                rows.append(f"<tr><td>{label}</td><td>{who}</td>{told_cells}</tr>")
    return section("NEES", _NEES_NOTE, _table(heads, rows))


def _judged(value: float | None) -> str:
    """Return a median, red when it is not as asked."""
    told, (low, high) = _plain(value), NEES_MEDIAN
    return (
        f"<span class=bad>{told}</span>" if value is not None and not low <= value <= high else told
    )


def _plain(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f}"


def _figures(
    result: PaperResult, flights: Mapping[tuple[str, bool], PaperFlight], of: str
) -> list[str]:
    out = []
    rotate = flights.get(("rotate", True))
    if rotate is not None:
        note = (
            "Grey: the drone's own fixes. In colour: what its observers propose. The surest "
            "observer is the one whose proposal states the smallest heading sigma."
        )
        out.append(section(f"Fig. 5: rotate{of}", note + _unsaid(rotate),
                           paper_figures.rotate_svg(rotate)))  # fmt: skip
    sparse = flights.get(("sparse", True))
    if sparse is not None:
        note = (
            "Grey: own fixes (intra). In colour: proposals of the host (inter). Ink: what was sent "
            "with fusion; brown: without. Crosses at the foot: refused frames."
        )
        svg = paper_figures.sparse_svg(sparse, flights.get(("sparse", False)))
        out.append(section(f"Fig. 7: sparse{of}", note + _unsaid(sparse), svg))
    for name in ("forward_back", "forward_back_near"):
        out += _forward_back(flights.get((name, True)), flights.get((name, False)), name + of)
    urban = flights.get(("urban", True))
    if urban is not None:
        updates = paper_flight_figures.map_updates(urban)
        told = f"{len(updates)} map updates after the first map." if updates else (
            "The map was never updated after the first one."
        )  # fmt: skip
        note = f"{told} Ticks at the foot of the landmarks: refused frames."
        svg = paper_flight_figures.urban_svg(urban, result.scenarios.get("urban"))
        out.append(section(f"Fig. 12: urban{of}", note, svg))
    return out


def _forward_back(fused: PaperFlight | None, unfused: PaperFlight | None, title: str) -> list[str]:
    if fused is None:
        return []
    note = (
        "Over the way along X; Y and Z are magnified against it. Dashed: truth. "
        "A wild pose of the unfused flight may lie outside."
    )
    svg = paper_flight_figures.trajectories_svg(fused, unfused)
    out = [section(f"Fig. 8: {title}", note, svg)]
    for figure, name in zip((9, 10), fused.experiment.targets, strict=False):
        note = (
            "Band: three sigmas as sent; a red ring: outside it; ink ticks at the foot: frames "
            "with a proposal fused. Both columns to one scale." + _unsaid(fused)
        )
        svg = paper_flight_figures.axis_errors_svg(fused, unfused, name)
        out.append(section(f"Fig. {figure}: {title}, {name}", note, svg))
    return out


def _unsaid(flight: PaperFlight) -> str:
    return "" if flight.estimates else _NO_SOURCES


def _how(result: PaperResult, paper: Mapping[str, Any]) -> str:
    rows = []
    for experiment in result.experiments:
        for tuned in experiment.tuned:
            setting = f"{'.'.join(tuned.setting.path)} = {tuned.setting.value}"
            rows.append((experiment.name, f"{setting}: {tuned.why}"))
    rows.append(("unfused", "inter.every_n_frames = 0: nobody asks; all else is the same"))
    for pipeline in paper["pipelines"].values():
        for name, told in pipeline["experiments"].items():
            for variant in ("fused", "unfused"):
                flight = told[variant]
                if flight is not None:
                    settings = ", ".join(f"{k} = {v}" for k, v in flight["settings"].items())
                    rows.append((
                        f"{name}, {variant}",
                        f"{told['seconds']:g} s at speed {flight['speed']}; "
                        f"{flight['map']['revisions']} map revisions; "
                        f"settings: {settings or 'defaults'}",
                    ))  # fmt: skip
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in rows) + "</dl>"


def _table(heads: Sequence[str], rows: Sequence[str]) -> str:
    head = "".join(f"<th>{head}</th>" for head in heads)
    return f"<div class=scroll><table><tr>{head}</tr>{''.join(rows)}</table></div>"
