"""``python -m sitl paper``: the paper's experiments, flown and laid beside the paper's figures.

In the output folder: ``paper.json`` with every number, ``paper.html`` for people,
``flights/EXPERIMENT/PIPELINE-fused|unfused`` with each flight as ``sitl fly`` leaves
it, and ``recordings`` unless they are kept elsewhere. What is there and still fits
is not made again, so a run that was interrupted goes on where it was.
"""

from __future__ import annotations

import fcntl
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from sitl.daemon_config import check_settings
from sitl.default_goals import default_goals
from sitl.embedded import DEMO
from sitl.fly import Progress
from sitl.goals import Goal
from sitl.paper_experiments import (
    EXPERIMENTS,
    PIPELINES,
    TABLE_I,
    Experiment,
    Pipeline,
    chosen,
    settings_of,
)
from sitl.paper_flights import PaperFlight, flown, variant_name
from sitl.paper_goals import goals
from sitl.paper_measures import compared, flight_measures
from sitl.paper_page import page
from sitl.paper_recordings import Rendered, rendered
from sitl.plan import FlyOptions, Setting, plan_flight
from sitl.processes import FlightError
from sitl.report import rounded
from sitl.scenario import Scenario, load_scenario
from vcl_companion.errors import ConfigError
from vcl_companion.recording import read_recording

Say = Callable[[str], None]

_MARK = "paper.lock"


@dataclass(frozen=True)
class PaperOptions:
    """What is flown and how.

    Attributes:
        only: names of experiments; empty: all.
        speed: recording seconds per wall second; infinite: as fast as all daemons keep up;
            None: each pipeline's own.
        settings: more of the daemons' configuration, for every flight.
        seconds: only so much of each scenario is rendered and flown; None: all of it.
        recordings: where rendered scenarios are kept; None: in the output folder.
        start_timeout_s: how long the daemons have to come up, and again for the first map.
    """

    only: tuple[str, ...] = ()
    speed: float | None = None
    settings: tuple[Setting, ...] = ()
    seconds: float | None = None
    recordings: Path | None = None
    start_timeout_s: float = 60.0

    def __post_init__(self) -> None:
        if self.seconds is not None and not 0.0 < self.seconds < math.inf:
            raise ConfigError(f"--seconds must be positive, got {self.seconds}")


@dataclass(frozen=True, eq=False)
class PaperResult:
    """What came of it.

    Attributes:
        experiments: those that were asked for.
        scenarios: of each, by its name, as it was flown.
        flights: of each pipeline's name: by (experiment, fused).
        goals: of each pipeline's name.
        failures: (flight, why) of flights that broke off.
        whole: False when scenarios were cut short.
    """

    experiments: tuple[Experiment, ...]
    scenarios: dict[str, Scenario] = field(default_factory=dict)
    flights: dict[str, dict[tuple[str, bool], PaperFlight]] = field(default_factory=dict)
    goals: dict[str, list[Goal]] = field(default_factory=dict)
    failures: list[tuple[str, str]] = field(default_factory=list)
    whole: bool = True


def make_paper(
    out: Path,
    options: PaperOptions,
    progress: Progress,
    say: Say,
    experiments: tuple[Experiment, ...] = EXPERIMENTS,
    pipelines: tuple[Pipeline, ...] = PIPELINES,
) -> PaperResult:
    """Render what is not rendered, fly what is not flown, and write ``paper.json`` and the page.

    A flight that breaks off is noted, and the others are flown.

    Raises:
        ConfigError: an option, or a folder, cannot be used.
        KeyboardInterrupt: on Ctrl-C; what is finished stays.
    """
    asked = chosen(experiments, options.only)
    _check(asked, pipelines, options)
    scenarios = {e.name: _cut(load_scenario(e.scenario), options.seconds) for e in asked}
    result = PaperResult(asked, scenarios, whole=options.seconds is None)
    recordings = options.recordings or out / "recordings"
    with _held(out, fresh=True), _held(recordings, fresh=False):
        for experiment in asked:
            recording = _recording(experiment, scenarios, recordings, options, progress, say)
            for pipeline in pipelines:
                for fused in experiment.variants():
                    _fly(experiment, pipeline, fused, recording, out, options, result,
                         progress, say)  # fmt: skip
        for pipeline in pipelines:
            flights = result.flights.setdefault(pipeline.name, {})
            asked_of = default_goals if pipeline.name == "default" else goals
            rows = asked_of(flights, whole=result.whole)
            names = ("", *(experiment.name for experiment in asked))
            result.goals[pipeline.name] = [goal for goal in rows if goal.experiment in names]
        progress("writing the page", 0, 0)
        _write(result, pipelines, out)
    return result


def _recording(
    experiment: Experiment,
    scenarios: dict[str, Scenario],
    folder: Path,
    options: PaperOptions,
    progress: Progress,
    say: Say,
) -> Rendered:
    label, name = _label(experiment, options), experiment.name
    done = rendered(
        scenarios[name], label, folder, lambda n, total: progress(f"{name}: rendering", n, total)
    )
    if done.reused:
        say(f"{name}: recording reused, {done.path}")
    else:
        say(f"{name}: rendered{f' anew, {done.why}' if done.why else ''}, {done.path}")
    return done


def _fly(
    experiment: Experiment,
    pipeline: Pipeline,
    fused: bool,
    recording: Rendered,
    out: Path,
    options: PaperOptions,
    result: PaperResult,
    progress: Progress,
    say: Say,
) -> None:
    name = f"{experiment.name}, {pipeline.name}, {variant_name(fused)}"
    folder = out / "flights" / _label(experiment, options)
    folder = folder / f"{pipeline.name}-{variant_name(fused)}"
    fly_options = _fly_options(experiment, pipeline, options, fused=fused)
    try:
        flight = flown(
            experiment, pipeline, fused, recording, folder, fly_options,
            lambda stage, n, total: progress(f"{name}: {stage}", n, total),
        )  # fmt: skip
    except FlightError as error:
        result.failures.append((name, str(error)))
        say(f"{name}: FAILED, {error}")
        return
    result.flights.setdefault(pipeline.name, {})[experiment.name, fused] = flight
    if flight.reused:
        say(f"{name}: flight reused, {folder}")
    else:
        say(f"{name}: flown{f' again, {flight.why}' if flight.why else ''}, {folder}")


def _fly_options(
    experiment: Experiment, pipeline: Pipeline, options: PaperOptions, *, fused: bool
) -> FlyOptions:
    return FlyOptions(
        speed=options.speed or pipeline.speed,
        start_timeout_s=options.start_timeout_s,
        settings=settings_of(experiment, pipeline, fused, options.settings),
    )


def _check(
    experiments: Sequence[Experiment], pipelines: Sequence[Pipeline], options: PaperOptions
) -> None:
    """Refuse settings that no daemon would start with, before hours are spent on them.

    The recordings are yet to be rendered: a flight of the demo's would refuse the same.
    """
    demo = read_recording(DEMO)
    for experiment in experiments:
        for pipeline in pipelines:
            for fused in experiment.variants():
                fly_options = _fly_options(experiment, pipeline, options, fused=fused)
                check_settings(plan_flight(demo, fly_options))


def _label(experiment: Experiment, options: PaperOptions) -> str:
    if options.seconds is None:
        return experiment.name
    return f"{experiment.name}-first-{options.seconds:g}s"


def _cut(scenario: Scenario, duration_s: float | None) -> Scenario:
    """Return a scenario, or the beginning of it."""
    if duration_s is None or duration_s >= scenario.duration_s:
        return scenario
    return msgspec.structs.replace(scenario, duration_s=duration_s)


@contextmanager
def _held(folder: Path, *, fresh: bool) -> Iterator[None]:
    """Have a folder for ourselves as long as we work in it.

    Args:
        folder: made when absent.
        fresh: whether it must be empty, or one that was worked in before.

    Raises:
        ConfigError: it cannot be had.
    """
    mark = folder / _MARK
    try:
        if folder.exists() and not folder.is_dir():
            raise ConfigError(f"{folder}: is a file; give a folder")
        if fresh and folder.is_dir() and any(folder.iterdir()) and not mark.exists():
            raise ConfigError(f"{folder}: holds something else; give another folder")
        folder.mkdir(parents=True, exist_ok=True)
        file = mark.open("a", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror})") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise ConfigError(f"{folder}: another run is at work in it") from None
        yield


def _write(result: PaperResult, pipelines: Sequence[Pipeline], out: Path) -> None:
    paper = paper_json(result, pipelines)
    text = json.dumps(paper, indent=1, ensure_ascii=False, allow_nan=False)
    try:
        (out / "paper.json").write_text(text + "\n", encoding="utf-8")
        (out / "paper.html").write_text(page(result, pipelines, paper), encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written ({error.strerror})") from error


def paper_json(result: PaperResult, pipelines: Sequence[Pipeline]) -> dict[str, Any]:
    """Return what ``paper.json`` says; what is not known is null."""
    return {
        "whole": result.whole,
        "failures": [{"flight": flight, "why": why} for flight, why in result.failures],
        "table_1_of_the_paper": {
            name: {"fused_cm": list(row.fused_cm), "unfused_cm": list(row.unfused_cm)}
            for name, row in TABLE_I.items()
        },
        "pipelines": {
            pipeline.name: _pipeline_json(result, pipeline.name) for pipeline in pipelines
        },
    }


def _pipeline_json(result: PaperResult, name: str) -> dict[str, Any]:
    flights = result.flights.get(name, {})
    experiments = {}
    for experiment in result.experiments:
        fused, unfused = (flights.get((experiment.name, with_)) for with_ in (True, False))
        both = fused is not None and unfused is not None
        experiments[experiment.name] = {
            "seconds": result.scenarios[experiment.name].duration_s,
            "fused": rounded(flight_measures(fused)) if fused else None,
            "unfused": rounded(flight_measures(unfused)) if unfused else None,
            "fused_against_unfused": {
                drone.name: rounded(compared(drone, unfused.drone(drone.name)))
                for drone in fused.result.drones
            }
            if both and fused and unfused
            else None,
        }
    return {
        "must_show": [asdict(goal) for goal in result.goals.get(name, [])],
        "experiments": experiments,
    }
