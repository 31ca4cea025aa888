"""Map extension by three drones beside a tracking load, by a process and a thread as a daemon's."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count, cycle

import numpy as np

from sitl.bench.figures import Figure
from sitl.bench.speed_frames import located
from sitl.bench.speed_scene import FEATURES, MAPPING, Scene, Shot
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.forked import Forked
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap, ready_map
from vcl_companion.daemon.scheduling import run_before_others
from vcl_companion.daemon.worker import Worker
from vcl_companion.errors import RecordingError
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.update import extended
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.map_codec import encode_map, revision_of

_RATE_HZ = 30.0
_SPACING_S = 1.2


@dataclass(frozen=True)
class _Round:
    """One extension: what each part of it took, s.

    Attributes:
        look_s: wall time to decode all frames and find their features, done as each comes.
        extend_s: wall time of the extension by frames that have been looked at.
        extend_cpu_s: processor time of that.
        ready_s: wall time until its map can be flown on.
        n_landmarks: of that map.
        n_keyframes: likewise.
    """

    look_s: float
    extend_s: float
    extend_cpu_s: float
    ready_s: float
    n_landmarks: int
    n_keyframes: int


def extension(scene: Scene, first: LandmarkMap, shots: list[Shot], n_rounds: int) -> list[Figure]:
    """Extend a map round after round while another thread localizes 30 frames a second.

    Args:
        scene: what the drones see.
        first: the map that they begin with.
        shots: frames for the tracking load, near the start.
        n_rounds: how many; every drone contributes one frame to each.

    Raises:
        RecordingError: a round gives no map.
    """
    mapping = Forked(_Maker(), {"maps": 8})
    vision = Worker("vision")
    vision.submit(run_before_others)
    ready: ReadyMap = mapping.call("maps", "begin", encode_map(first)).result()
    contributed = [
        [scene.shot(i, _SPACING_S * (k + 1)) for i in range(len(scene.scenario.drone))]
        for k in range(n_rounds)
    ]
    load = _Load(vision, shots, ready)
    alone_ms = load.during(lambda: time.sleep(1.0))
    rounds: list[_Round] = []

    def extend() -> None:
        for k, seen in enumerate(contributed):
            views = [shot.view(k + 1, detected=False) for shot in seen]
            looks = [mapping.call("maps", "look_at", view).result() for view in views]
            rounds.append(mapping.call("maps", "extend", views, k, sum(looks)).result())

    beside_ms = load.during(extend)
    vision.shutdown()
    mapping.end()
    walls = [r.extend_s for r in rounds]
    last = rounds[-1]
    size = f"{n_rounds} rounds, to {last.n_landmarks} landmarks in {last.n_keyframes} keyframes"
    return [
        Figure("map extension, median", float(np.median(walls)), "s", 0.6,
               note=f"wall time beside the load, frames looked at before as they come; {size}"),
        Figure("its frames looked at, median", float(np.median([r.look_s for r in rounds])), "s",
               note="wall time beside the load of all drones' frames, each as it comes"),
        Figure("map extension, longest", float(np.max(walls)), "s"),
        Figure("map extension, processor time", float(np.median([r.extend_cpu_s for r in rounds])),
               "s", note="median"),
        Figure("extended map made ready", float(np.median([r.ready_s for r in rounds])), "s",
               note="wall time, in every drone"),
        Figure("load alone, p95", float(np.quantile(alone_ms, 0.95)), "ms",
               note=f"{len(alone_ms)} frames at {_RATE_HZ:g} Hz, wall time"),
        Figure("load beside the extension, median", float(np.median(beside_ms)), "ms"),
        Figure("load beside the extension, p95", float(np.quantile(beside_ms, 0.95)), "ms",
               note=f"{len(beside_ms)} frames"),
    ]  # fmt: skip


class _Maker:
    """Extends a map that it keeps."""

    def __init__(self) -> None:
        self._memory = FeatureMemory(FEATURES)
        self._current: ReadyMap | None = None

    def begin(self, data: bytes) -> ReadyMap:
        """Make an encoded map ready, and the one to be extended."""
        offer = MapOffer.of(BlobKind.MAP, data)
        self._current = ready_map(offer, None, "akaze", FEATURES, self._memory, True, {})
        return self._current

    def look_at(self, view: DroneView) -> float:
        """Do what a daemon does with a frame as it comes (``Workshop.look_at``); return s taken."""
        begun_s = time.perf_counter()
        self._memory.pyramid(view.image_bytes, view.camera)
        self._memory.features(view.image_bytes, view.camera, MAPPING.detectors[0])
        return time.perf_counter() - begun_s

    def extend(self, views: list[DroneView], k: int, look_s: float) -> _Round:
        """Extend it by frames, and make what came of it ready."""
        if self._current is None:
            raise RuntimeError("there is no map yet")
        index = self._current.index
        old, revision = index.landmark_map, revision_of(self._current.data)
        begun_s, cpu_s = time.perf_counter(), time.thread_time()
        made = extended(
            old, revision, views, self._memory.features, MAPPING,
            pyramid_of=self._memory.pyramid, sure=index.uncertainty,
        )  # fmt: skip
        extend_s, extend_cpu_s = time.perf_counter() - begun_s, time.thread_time() - cpu_s
        if isinstance(made, NoMap):
            raise RecordingError(f"round {k + 1}: the map cannot be extended: {made.reason}")
        begun_s = time.perf_counter()
        self.begin(encode_map(made))
        return _Round(
            look_s,
            extend_s,
            extend_cpu_s,
            time.perf_counter() - begun_s,
            len(made.points_world),
            len(made.keyframes),
        )


class _Load:
    """Localizes frames in their own time by one thread, as the frames of a camera come."""

    def __init__(self, vision: Worker, shots: list[Shot], ready: ReadyMap) -> None:
        self._vision, self._shots, self._ready = vision, shots, ready

    def during(self, work: Callable[[], None]) -> list[float]:
        """Do some work, and return the wall time that each frame meanwhile took, ms."""
        times: list[float] = []
        over = threading.Event()

        def frames() -> None:
            begun_s = time.perf_counter()
            for k, shot in zip(count(), cycle(self._shots), strict=False):
                due_s = begun_s + k / _RATE_HZ
                if over.wait(max(0.0, due_s - time.perf_counter())):
                    return
                prior = shot.predicted(np.random.default_rng(k))
                asked_s = time.perf_counter()
                self._vision.submit(located, shot, self._ready, True, prior).result()
                times.append(1e3 * (time.perf_counter() - asked_s))

        thread = threading.Thread(target=frames, name="camera")
        located(self._shots[0], self._ready, True, None)
        thread.start()
        try:
            work()
        finally:
            over.set()
            thread.join()
        return times
