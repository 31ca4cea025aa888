"""The paper's four experiments: which scenario is flown how often, with which settings and why."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import dataclass

from sitl.plan import Setting, pipeline_setting
from vcl_companion.errors import ConfigError

# A drone's board has four processors or more. Three drones, the autopilots and the cameras
# share those of this machine: the recording's time runs as much slower as there are fewer.
_PROCESSORS = 4.5


def boards_speed() -> float:
    """Return recording seconds per wall second that leave each drone 1.5 processors; at most 1."""
    count = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    return min(1.0, count / _PROCESSORS)


# Nobody asks anybody; the same daemons, maps and frames otherwise.
NOT_FUSED = Setting(("inter", "every_n_frames"), 0)


@dataclass(frozen=True)
class Tuned:
    """A setting that an experiment needs, and the reason."""

    setting: Setting
    why: str


@dataclass(frozen=True)
class Pipeline:
    """A way to localize; each is a column of the page.

    Attributes:
        name: key in ``paper.json`` and folder of its flights.
        title: for people.
        speed: recording seconds per wall second that it is flown at; infinite: as fast as
            all daemons and their maps keep up, where they do not in real time.
        settings: what makes a daemon localize like this.
    """

    name: str
    title: str
    speed: float
    settings: tuple[Setting, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """One scenario of the paper.

    Attributes:
        name: for ``--only``, and key in ``paper.json``.
        title: for people.
        scenario: name of an embedded scenario, or a file.
        targets: drones that the experiment is about.
        compared: whether it is also flown without fusion.
        tuned: settings of its own.
    """

    name: str
    title: str
    scenario: str
    targets: tuple[str, ...]
    compared: bool = True
    tuned: tuple[Tuned, ...] = ()

    def variants(self) -> tuple[bool, ...]:
        """Return the flights of one pipeline: fused, and where it is compared unfused."""
        return (True, False) if self.compared else (True,)


PIPELINES = (
    Pipeline("default", "the default pipeline", boards_speed()),
    Pipeline("paper", "the paper's pipeline", math.inf, (pipeline_setting("paper"),)),
)

_EVERY_IMAGE = Tuned(
    Setting(("inter", "every_n_frames"), 1),
    "fig. 5 shows what the observers say of every image of the turn, not of some",
)
_NO_PAUSE = Tuned(
    Setting(("inter", "least_interval_s"), 0.0), "so many images a second are asked about then"
)
_EVERY_TENTH = Tuned(
    Setting(("inter", "every_n_frames"), 10),
    "the paper fuses every 10 images here; held, should the default ever change",
)

EXPERIMENTS = (
    Experiment(
        "rotate",
        "1: turning in place between two perpendicular buildings",
        "rotate",
        ("mav0",),
        tuned=(_NO_PAUSE, _EVERY_IMAGE),
    ),
    Experiment(
        "sparse", "2: one rich building, vertical flight of two targets", "sparse", ("mav1", "mav2")
    ),
    Experiment(
        "forward_back",
        "3: 60 m backward and forward, 20 to 50 m from the façade",
        "forward_back",
        ("mav1", "mav2"),
        tuned=(_EVERY_TENTH,),
    ),
    Experiment(
        "forward_back_near",
        "3, harder: the same from 12 to 42 m",
        "forward_back_near",
        ("mav1", "mav2"),
        tuned=(_EVERY_TENTH,),
    ),
    Experiment(
        "forward_back_noisy",
        "3, as a poor camera sees it: noise of 6 grey levels, blur of 1 px",
        "forward_back_noisy",
        ("mav1", "mav2"),
        compared=False,
        tuned=(_EVERY_TENTH,),
    ),
    Experiment(
        "urban",
        "4: 100 m of street with a turn, the map growing",
        "urban",
        ("mav0", "mav1", "mav2"),
        compared=False,
    ),
)


@dataclass(frozen=True)
class AxisErrors:
    """RMS errors of one drone along X, Y and Z, cm, with fusion and without."""

    fused_cm: tuple[float, float, float]
    unfused_cm: tuple[float, float, float]


TABLE_I = {
    "mav1": AxisErrors((2.5, 23.9, 0.4), (3.6, 35.2, 3.0)),
    "mav2": AxisErrors((0.5, 12.0, 0.7), (1.9, 17.9, 5.4)),
}
"""What the paper's Table I says of its forward-backward flight."""


def settings_of(
    experiment: Experiment, pipeline: Pipeline, fused: bool, given: tuple[Setting, ...]
) -> tuple[Setting, ...]:
    """Return all settings of a flight, later ones winning.

    What a person gives beats the experiment's own, but an unfused flight stays unfused.
    """
    own = tuple(tuned.setting for tuned in experiment.tuned)
    return (*pipeline.settings, *own, *given, *(() if fused else (NOT_FUSED,)))


def pipelines_named(names: tuple[str, ...]) -> tuple[Pipeline, ...]:
    """Return the pipelines of these names, in their own order; all when none is named."""
    return tuple(p for p in PIPELINES if not names or p.name in names)


def chosen(experiments: tuple[Experiment, ...], only: tuple[str, ...]) -> tuple[Experiment, ...]:
    """Return the experiments of these names, in their own order; all when none is named.

    Raises:
        ConfigError: there is none of a name.
    """
    names = [experiment.name for experiment in experiments]
    for name in only:
        if name not in names:
            raise ConfigError(f"--only {name}: no such experiment; there are: {', '.join(names)}")
    return tuple(e for e in experiments if not only or e.name in only)
