"""``bench speed``: the time of a frame beside the paper's, of maps, and how costs grow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2

from sitl.bench.figures import Figure
from sitl.bench.speed_extension import extension
from sitl.bench.speed_frames import cold_start, made_ready, relocalization, shots_of, side_by_side
from sitl.bench.speed_growth import CostTable, by_image_size, by_landmarks
from sitl.bench.speed_memory import memory
from sitl.bench.speed_report import write_speed
from sitl.bench.speed_scene import Scene
from sitl.bench.timing import Effort
from sitl.scenario import load_scenario

Progress = Callable[[str, int, int], None]

PARTS = ("frame", "extension", "memory", "landmarks", "images")
_SCENARIO = "demo"


@dataclass(frozen=True)
class _Extent:
    """How much is measured."""

    frames: Effort
    maps: Effort
    instants: int
    rounds: int
    map_sizes: tuple[int, ...]
    revisions: int
    landmarks: tuple[int, ...]
    sizes_px: tuple[tuple[int, int], ...]


_USUAL = _Extent(
    Effort(20.0, 40, 400),
    Effort(4.0, 5, 60),
    6,
    4,
    (1000, 4000, 12_000),
    20,
    (200, 1000, 5000, 20_000, 100_000),
    ((320, 240), (640, 480), (1280, 800)),
)
_QUICK = _Extent(
    Effort(0.0, 2, 2),
    Effort(0.0, 1, 1),
    1,
    1,
    (1000,),
    3,
    (200, 1000),
    ((320, 240), (480, 360)),
)


@dataclass(frozen=True)
class SpeedResult:
    """What was measured.

    Attributes:
        figures: single numbers, with their goals.
        tables: costs by size.
    """

    figures: tuple[Figure, ...]
    tables: tuple[CostTable, ...]


def bench_speed(out: Path, parts: tuple[str, ...], quick: bool, progress: Progress) -> SpeedResult:
    """Measure some of ``PARTS``; write ``speed.json`` and ``speed.md`` into a folder.

    Args:
        out: folder, made if absent.
        parts: some of ``PARTS``.
        quick: as little as shows that it runs.
        progress: called with what is running, how much of it is done, and of how much.
    """
    cv2.setNumThreads(1)
    extent = _QUICK if quick else _USUAL
    scenario = load_scenario(_SCENARIO)
    figures: list[Figure] = []
    tables: list[CostTable] = []
    if "frame" in parts or "extension" in parts:
        progress("images and map", 0, 4)
        scene = Scene(scenario)
        first = scene.first_map()
        shots = shots_of(scene, extent.instants)
    if "frame" in parts:
        ready = made_ready(first)
        progress("frames", 1, 4)
        figures += side_by_side(shots, ready, extent.frames)
        progress("relocalization", 2, 4)
        figures += relocalization(shots, ready, extent.maps)
        progress("cold start", 3, 4)
        figures += cold_start(shots, first, extent.maps)
    if "extension" in parts:
        progress("map extension", 3, 4)
        figures += extension(scene, first, shots, extent.rounds)
    if "memory" in parts:
        figures += memory(scenario, extent.map_sizes, extent.revisions, progress)
    if "landmarks" in parts:
        tables.append(by_landmarks(scenario, extent.landmarks, extent.maps, progress))
    if "images" in parts:
        tables.append(by_image_size(scenario, extent.sizes_px, extent.maps, progress))
    result = SpeedResult(tuple(figures), tuple(tables))
    write_speed(out, result.figures, result.tables)
    return result
