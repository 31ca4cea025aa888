"""How costs grow with the landmarks of the map, and with the size of the images."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle

import numpy as np

from sitl.bench.figures import Growth
from sitl.bench.large_maps import MANY_FEATURES, Place, large_map, places
from sitl.bench.speed_frames import OPTIONS, in_view, is_right, located, made_ready, shots_of
from sitl.bench.speed_scene import FEATURES, Scene, Shot, table_bytes
from sitl.bench.timing import Effort, interleaved
from sitl.scenario import Scenario
from vcl_companion.daemon.map_offer import ReadyMap
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.map_index import index_map
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.templates import prepare_templates
from vcl_companion.vision.features import Features, detect

Progress = Callable[[str, int, int], None]

COLUMNS = ("tracking", "relocalization", "prepare", "memory")
_UNITS = ("ms", "ms", "ms", "MB")


@dataclass(frozen=True)
class CostRow:
    """What one size costs.

    Attributes:
        size: number of landmarks, or of pixels.
        name: for people.
        in_view: landmarks that a frame can choose from, median.
        costs: tracking, relocalization, ms; prepare, ms; memory, MB.
        right: share of the poses that were, 0 to 1.
    """

    size: float
    name: str
    in_view: float
    costs: tuple[float, float, float, float]
    right: float


@dataclass(frozen=True)
class CostTable:
    """Costs by size, and how they grow.

    Attributes:
        title: what the size is.
        note: how the inputs were made, and what is measured.
        rows: by rising size.
    """

    title: str
    note: str
    rows: tuple[CostRow, ...]

    def growths(self) -> tuple[Growth, ...]:
        """Return how each cost grows."""
        sizes = tuple(row.size for row in self.rows)
        return tuple(
            Growth(name, unit, sizes, tuple(row.costs[k] for row in self.rows))
            for k, (name, unit) in enumerate(zip(COLUMNS, _UNITS, strict=True))
        )


def by_landmarks(
    scenario: Scenario, sizes: Sequence[int], effort: Effort, progress: Progress
) -> CostTable:
    """Measure maps of some sizes; each place of them is rendered once."""
    source, made = places(scenario), list[Place]()
    rows = []
    for done, size in enumerate(sizes):
        while sum(len(place.points) for place in made) < size:
            progress(f"landmarks: {len(made) + 1} places", done, len(sizes))
            made.append(next(source))
        progress(f"landmarks: {size}", done, len(sizes))
        rows.append(_row_of_map(made[0].scene, large_map(made, size), size, effort))
    return CostTable(
        "landmarks in the map",
        "Places rendered side by side, the same town with other looks, two keyframes each; "
        "landmarks are AKAZE features at the rendered depth, places tied by 60 far points each. "
        "A frame shows the first place, whatever is beside it. Relocalization: matching with "
        "the whole map and the pose, AKAZE of the frame left out. Prepare: index, covariance and "
        "patches, AKAZE of the keyframes left out. More than 16 000 landmarks or 64 keyframes "
        "no daemon's map may have: those rows are there for the growth.",
        tuple(rows),
    )


def by_image_size(
    scenario: Scenario, sizes: Sequence[tuple[int, int]], effort: Effort, progress: Progress
) -> CostTable:
    """Measure images of some sizes, each with a map made of such."""
    rows = []
    world = Scene(scenario).world
    for done, size_px in enumerate(sizes):
        name = f"{size_px[0]}x{size_px[1]}"
        progress(f"images: {name}", done, len(sizes))
        scene = Scene(scenario, size_px, world)
        first = scene.first_map()
        prepared_ms, ready = _timed(partial(made_ready, first))
        shots = shots_of(scene, 2)
        lost = [partial(located, shot, ready, True, None) for shot in shots]
        rows.append(
            _row(
                float(size_px[0] * size_px[1]),
                f"{name}, {len(first.points_world)} landmarks",
                ready,
                shots,
                lost,
                prepared_ms,
                effort,
            )
        )
    return CostTable(
        "pixels of the image",
        "The same flight through a lens of the same angle; the map of the three first images. "
        "Relocalization with AKAZE of the frame; prepare with AKAZE of the keyframes.",
        tuple(rows),
    )


def _row_of_map(scene: Scene, made: LandmarkMap, size: int, effort: Effort) -> CostRow:
    found: dict[bytes, Features] = {}

    def features_of(keyframe: Keyframe) -> Features:
        if keyframe.image_bytes not in found:
            found[keyframe.image_bytes] = detect(
                decode_image(keyframe.image_bytes, keyframe.camera), "akaze", MANY_FEATURES
            )
        return found[keyframe.image_bytes]

    for keyframe in made.keyframes:
        features_of(keyframe)

    def prepared() -> ReadyMap:
        index = index_map(made, "akaze", MANY_FEATURES, features_of)
        return ReadyMap(b"", index, b"", prepare_templates(made, index.uncertainty))

    prepared_ms, ready = _timed(prepared)
    # Neither of the drones that made the map, nor their places.
    shots = [scene.shot(i, at_s) for i, at_s in ((2, 0.0), (2, 0.8), (0, 1.2), (1, 1.6))]
    features = [detect(shot.image, "akaze", FEATURES) for shot in shots]

    def lost(shot: Shot, seen: Features) -> bool:
        pose = localize_intra(
            seen, shot.camera, shot.body_from_cam, ready.index, None,
            shot.world_from_body.rotation, OPTIONS.localization,
        )  # fmt: skip
        return is_right(shot, pose)

    return _row(
        float(size),
        f"{size} in {len(made.keyframes)} keyframes",
        ready,
        shots,
        [partial(lost, shot, seen) for shot, seen in zip(shots, features, strict=True)],
        prepared_ms,
        effort,
    )


def _row(
    size: float,
    name: str,
    ready: ReadyMap,
    shots: list[Shot],
    lost: Sequence[Callable[[], bool]],
    prepared_ms: float,
    effort: Effort,
) -> CostRow:
    """Measure frames with a prediction, and without one as ``lost`` says, in turns."""
    tracked = [
        partial(located, shot, ready, True, shot.predicted(np.random.default_rng(k)))
        for k, shot in enumerate(shots)
    ]
    right: list[bool] = []
    times = interleaved([_in_turn(tracked, right), _in_turn(lost, right)], effort)
    tracked_ms, lost_ms = (float(np.median(mine)) for mine in times)
    return CostRow(
        size,
        name,
        float(np.median([in_view(shot, ready) for shot in shots])),
        (tracked_ms, lost_ms, prepared_ms, _megabytes(ready)),
        float(np.mean(right)),
    )


def _in_turn(runs: Sequence[Callable[[], bool]], right: list[bool]) -> Callable[[], None]:
    turn = cycle(runs)

    def once() -> None:
        right.append(next(turn)())

    once()  # what is loaded at the first call is not measured
    return once


def _timed(make: Callable[[], ReadyMap]) -> tuple[float, ReadyMap]:
    """Return the processor time of making a map ready, once, ms, and the map."""
    began_ns = time.process_time_ns()
    made = make()
    return 1e-6 * (time.process_time_ns() - began_ns), made


def _megabytes(ready: ReadyMap) -> float:
    return 1e-6 * (0 if ready.templates is None else table_bytes(ready.index, ready.templates))
