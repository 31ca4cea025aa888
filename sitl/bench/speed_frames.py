"""The time of one frame: tracked, by the paper's pipeline, relocalized, and from a cold start."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import count, cycle

import numpy as np

from sitl.bench.figures import Figure, median_and_p95
from sitl.bench.speed_scene import FEATURES, Scene, Shot
from sitl.bench.timing import Effort, interleaved
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap, ready_map
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions, localize
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.vision.patch_choice import choose_anchors
from vcl_companion.vision.patch_tables import lens_of
from vcl_companion.wire.map_codec import encode_map

OPTIONS = PipelineOptions(FEATURES, LocalizationOptions(), TrackingOptions())

_RIGHT_M = 0.15
_START = (
    "import cv2; cv2.setNumThreads(1)\n"
    "import vcl_companion.daemon.assemble\n"
    "from vcl_companion.wire.warm_up import warm_up; warm_up()"
)


def made_ready(landmark_map: LandmarkMap) -> ReadyMap:
    """Do what a daemon does with a map before it is flown on."""
    offer = MapOffer.of(BlobKind.MAP, encode_map(landmark_map))
    return ready_map(offer, None, "akaze", FEATURES, FeatureMemory(FEATURES), True, {})


def shots_of(scene: Scene, n_instants: int) -> list[Shot]:
    """Return images of all drones soon after the map was made, of other places than its own."""
    instants = np.linspace(0.6, 2.4, n_instants)
    return [scene.shot(i, at_s) for at_s in instants for i in range(len(scene.scenario.drone))]


def located(shot: Shot, ready: ReadyMap, tracked: bool, prior: Prior | None) -> bool:
    """Localize one image; whether the pose is right."""
    found = localize(
        shot.image, shot.camera, shot.body_from_cam, ready.index,
        ready.templates if tracked else None, prior, shot.world_from_body.rotation, OPTIONS,
    )  # fmt: skip
    return is_right(shot, found)


def in_view(shot: Shot, ready: ReadyMap) -> int:
    """Return how many landmarks could be tracked in an image."""
    if ready.templates is None:
        return 0
    prior = shot.predicted(np.random.default_rng(0))
    *_, n = choose_anchors(
        ready.templates.anchors, lens_of(shot.camera), shot.world_from_body, shot.body_from_cam,
        prior.covariance, OPTIONS.tracking.choice(), OPTIONS.tracking.n_landmarks, 6.0,
    )  # fmt: skip
    return n


def side_by_side(shots: list[Shot], ready: ReadyMap, effort: Effort) -> list[Figure]:
    """Measure the default pipeline's frame beside the paper's, in turns, both with a prediction."""
    answers: dict[str, list[bool]] = {"default": [], "paper": []}

    def run(name: str) -> Callable[[], None]:
        turn = _turns(shots)

        def once() -> None:
            shot, prior = next(turn)
            answers[name].append(located(shot, ready, name == "default", prior))

        return once

    runs = [run("default"), run("paper")]
    for once in runs:
        once()
    default, paper = interleaved(runs, effort)
    times = f"{len(default)} frames, processor time"
    ratio = float(np.median(paper) / np.median(default))
    n_view = float(np.median([in_view(shot, ready) for shot in shots]))
    return [
        Figure("landmarks in view", n_view, "", note="median over the frames"),
        *median_and_p95("default pipeline, frame", default, (6.0, 10.0), times),
        *median_and_p95("paper pipeline, frame", paper, (None, None), times),
        Figure("frames per second, default over paper", ratio, "times", 15.0, True),
        *(
            Figure(f"{name} pipeline, right", 100.0 * float(np.mean(right)), "%",
                   note=f"within {_RIGHT_M:g} m of the truth")
            for name, right in answers.items()
        ),
    ]  # fmt: skip


def relocalization(shots: list[Shot], ready: ReadyMap, effort: Effort) -> list[Figure]:
    """Measure a frame without a prediction: features, the whole map, then patches."""
    turn, right = _turns(shots), []

    def once() -> None:
        shot, _ = next(turn)
        right.append(located(shot, ready, True, None))

    once()
    (times,) = interleaved([once], effort)
    return [
        *median_and_p95("relocalization", times, (120.0, None), f"{len(times)} frames"),
        Figure("relocalization, right", 100.0 * float(np.mean(right)), "%"),
    ]


def cold_start(shots: list[Shot], landmark_map: LandmarkMap, effort: Effort) -> list[Figure]:
    """Measure how long a stored map takes until the first pose, and a process until it is ready."""
    data = encode_map(landmark_map)
    turn = cycle(shots)

    def prepared() -> ReadyMap:
        offer = MapOffer.of(BlobKind.MAP, data)
        return ready_map(offer, None, "akaze", FEATURES, FeatureMemory(FEATURES), True, {})

    def once() -> None:
        located(next(turn), prepared(), True, None)

    once()
    ready_ms, all_ms = interleaved([prepared, once], effort)
    begun_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", _START], check=True)
    start_s = time.perf_counter() - begun_s
    n = f"{len(landmark_map.points_world)} landmarks in {len(landmark_map.keyframes)} keyframes"
    return [
        Figure("map made ready", 1e-3 * float(np.median(ready_ms)), "s",
               note=f"decoded, indexed, patches cut: {n}"),
        Figure("stored map to first pose", 1e-3 * float(np.median(all_ms)), "s", 1.0),
        Figure("process started and warmed up", start_s, "s",
               note="wall time; compiled code on disk"),
    ]  # fmt: skip


def _turns(shots: list[Shot]) -> Iterator[tuple[Shot, Prior]]:
    """Yield images in turn, each time with another prediction."""
    for seed, shot in zip(count(), cycle(shots), strict=False):
        yield shot, shot.predicted(np.random.default_rng(seed))


def is_right(shot: Shot, found: Localized | NotLocalized) -> bool:
    """Whether a pose was found, and it is where the drone was."""
    if isinstance(found, NotLocalized):
        return False
    off = found.world_from_body.translation - shot.world_from_body.translation
    return bool(np.linalg.norm(off) < _RIGHT_M)
