"""Memory of a daemon by the size of its map and the length of its flight."""

from __future__ import annotations

import asyncio
import gc
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace

import cv2

from sitl.bench.figures import Figure
from sitl.bench.large_maps import Place, large_map, places
from sitl.bench.speed_frames import OPTIONS
from sitl.bench.speed_scene import MAPPING, table_bytes
from sitl.scenario import Scenario
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.memory_watch import MemoryWatch
from vcl_companion.daemon.usage import give_back_files, give_back_freed, share_freed
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.map_codec import decode_map, encode_map
from vcl_companion.wire.warm_up import warm_up

Progress = Callable[[str, int, int], None]

# What is kept of a map that was left would be there twice and more often by then.
_MOST_GROWN = 1.2


@dataclass(frozen=True)
class _Taken:
    """What both processes of a daemon take, MB: before, after each revision, at most; the map."""

    before: float
    after: tuple[float, ...]
    most: float
    tables: float


def memory(
    scenario: Scenario, sizes: Sequence[int], n_revisions: int, progress: Progress
) -> list[Figure]:
    """Make a daemon's maps, revision after revision, each time in processes begun for that.

    Args:
        scenario: what is rendered, see ``large_maps``.
        sizes: landmarks.
        n_revisions: how long a flight is, two at least.
        progress: told what is done, how far it is, and of how much.
    """
    source, made = places(scenario), list[Place]()
    figures: list[Figure] = []
    sensor = scenario.sensor(scenario.drone[0])
    for done, size in enumerate(sizes):
        while sum(len(place.points) for place in made) < size:
            progress(f"memory: {len(made) + 1} places", done, len(sizes))
            made.append(next(source))
        progress(f"memory: {size} landmarks", done, len(sizes))
        data = encode_map(large_map(made, size))
        # Not forked off this one: what that has taken for the rendering would count.
        apart = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=apart) as pool:
            taken = pool.submit(_taken, data, sensor, n_revisions).result()
        figures += _figures_of(size, taken)
    return figures


def _figures_of(size: int, taken: _Taken) -> list[Figure]:
    name, n = f"memory, {size} landmarks", len(taken.after)
    beyond = [after - taken.before for after in taken.after]
    most = taken.most - taken.before

    def times(megabytes: float) -> str:
        return f"{megabytes / taken.tables:.1f} times its tables"

    return [
        Figure(f"{name}, tables", taken.tables, "MB"),
        Figure(f"{name}, 1 revision", beyond[0], "MB", note=times(beyond[0])),
        Figure(f"{name}, {n} revisions", beyond[-1], "MB", note=times(beyond[-1])),
        Figure(f"{name}, {n} revisions over 2", beyond[-1] / beyond[1], "", _MOST_GROWN),
        Figure(f"{name}, at most", most, "MB", note=times(most)),
        Figure(f"{name}, before the first map", taken.before, "MB"),
    ]


def _taken(data: bytes, sensor: Sensor, n_revisions: int) -> _Taken:
    """Have revisions of a map made ready as a daemon has, each in the place of the last."""
    cv2.setNumThreads(1)
    share_freed()
    warm_up()
    gc.collect()
    gc.freeze()
    give_back_freed()
    give_back_files()
    options = WorkOptions((), MAPPING, OPTIONS, MAPPING.detectors, InterMavOptions(), tracked=True)
    return asyncio.run(_flown(Workshop(sensor, options), decode_map(data), n_revisions))


async def _flown(shop: Workshop, made: LandmarkMap, n_revisions: int) -> _Taken:
    work, maps = MapWork(shop, forks=True), MapStore("")
    watch = MemoryWatch(work.pid)
    watching = asyncio.ensure_future(watch.run())
    before, after = watch.now_mb(), list[float]()
    for k in range(n_revisions):
        await _replaced(work, maps, made, k)
        give_back_freed()
        after.append(watch.now_mb())
    watching.cancel()
    most = max(watch.most_mb(), *after)  # it looks five times a second only
    work.end()
    assert maps.current is not None
    assert maps.current.templates is not None
    tables = 1e-6 * table_bytes(maps.current.index, maps.current.templates)
    return _Taken(before, tuple(after), most, tables)


async def _replaced(work: MapWork, maps: MapStore, made: LandmarkMap, k: int) -> StoredMap:
    """Fly on the k-th revision of a map."""
    current = maps.current
    if current is not None:
        # Another map by its name, and not by what it takes.
        noise_px = made.pixel_noise_px * (1.0 + 1e-3 * k)
        made = replace(made, parent=current.revision, world=current.world, pixel_noise_px=noise_px)
    handed = await work.encoded(made, current)
    offer = replace(MapOffer.of(BlobKind.MAP, handed.data), update=handed.update)
    ready = await work.ready(offer, current, {})
    return maps.replace(ready.data, ready.index, ready.update, ready.templates)
