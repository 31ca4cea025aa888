"""``bench steps``: the time of each step and whether its answer is right, ours beside others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from sitl.bench import steps_images, steps_map, steps_poses
from sitl.bench.inputs import Inputs, prepare
from sitl.bench.steps_report import write_steps
from sitl.bench.timing import Effort, Entry, Measured, measured

_USUAL = Effort(budget_s=10.0, least=7, most=200)
_QUICK = Effort(budget_s=0.0, least=1, most=1)


@dataclass(frozen=True)
class Step:
    """One step of the method.

    Attributes:
        name: on the command line and in the tables.
        entries: the ways to do it, ours first.
    """

    name: str
    entries: Callable[[Inputs], list[Entry]]


STEPS = (
    Step("detect", steps_images.detection),
    Step("match", steps_images.matching),
    Step("match-map", steps_images.guided_matching),
    Step("relative", steps_poses.relative),
    Step("relative-made", steps_poses.relative_made),
    Step("resection", steps_poses.resection),
    Step("resection-made", steps_poses.resection_made),
    Step("refine", steps_poses.refinement),
    Step("triangulate", steps_poses.correction),
    Step("bundle", steps_map.adjustment),
    Step("index", steps_map.indexing),
    Step("localize", steps_map.localization),
)


def bench_steps(
    out: Path, steps: Sequence[Step], quick: bool, progress: Callable[[str, int, int], None]
) -> list[Measured]:
    """Measure steps one after the other; write ``steps.json`` and ``steps.md`` into a folder.

    Args:
        out: folder, made if absent.
        steps: some of ``STEPS``.
        quick: once each, to see that all answers are right.
        progress: called with what is running, how much of it is done, and of how much.
    """
    cv2.setNumThreads(1)
    progress("images and map", 0, len(steps))
    inputs = prepare()
    results: list[Measured] = []
    for done, step in enumerate(steps):
        progress(step.name, done, len(steps))
        results += measured(step.name, step.entries(inputs), _QUICK if quick else _USUAL)
    progress("steps", len(steps), len(steps))
    write_steps(out, results)
    return results
