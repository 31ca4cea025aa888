"""A drone that goes on by its own frames from where a map ends, as its daemon does."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.workshop import Workshop
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.pipeline import PipelineOptions, follow, follow_own_views
from vcl_companion.mapping.templates import Templates
from vcl_companion.recording.sensor import Sensor
from vcl_companion.vision.features import Image

# A prediction as a filter's between frames, 1 sigma; it is told as twice that.
_PREDICTED = np.array([0.02] * 3 + [0.002] * 3)
# As if the map showed so little: own frames are got ready.
_LITTLE = 0.1
_WORLD = b"", 0

_Follows = Callable[
    [Image, Camera, Pose, Templates, Prior, Array | None, PipelineOptions],
    Localized | NotLocalized,
]


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame, and world_from_body where it was taken, by the truth."""

    frame: Frame
    true: Pose


def predicted(where: Pose, rng: np.random.Generator) -> Prior:
    """Return where a filter may expect a drone that is somewhere."""
    off = _PREDICTED * rng.standard_normal(len(_PREDICTED))
    return Prior(where.retracted(off), np.diag((2.0 * _PREDICTED) ** 2))


def found_alone(
    on_map: Sequence[Shot],
    beyond: Sequence[Shot],
    templates: Templates,
    sensor: Sensor,
    workshop: Workshop,
    options: PipelineOptions,
    rng: np.random.Generator,
) -> list[Localized | None]:
    """Follow a drone on a map, and from where that ends by its own frames.

    Args:
        on_map: frames that the map may show, the last one at its end.
        beyond: those after, for which there is no map.
        templates: the map.
        sensor: the drone's.
        workshop: makes local maps.
        options: of the steps, with the drone's id.
        rng: of the predictions' errors.

    Returns:
        Where those beyond are found, None where they are lost; nothing of who has hardly moved
        before, and has no own frames to go on by.
    """
    return asyncio.run(_Flight(templates, sensor, workshop, options, rng).flown(on_map, beyond))


class _Flight:
    def __init__(
        self,
        templates: Templates,
        sensor: Sensor,
        workshop: Workshop,
        options: PipelineOptions,
        rng: np.random.Generator,
    ) -> None:
        self._templates = templates
        self._sensor = sensor
        self._work = MapWork(workshop, forks=False)
        self._options = options
        self._rng = rng
        self._odometry = Odometry(sensor, options.drone_id or 0, self._work)
        # Of the last fix: a prediction is off as that is.
        self._off = np.zeros(6)

    async def flown(self, on_map: Sequence[Shot], beyond: Sequence[Shot]) -> list[Localized | None]:
        making = asyncio.create_task(self._odometry.run())
        is_first = True
        for shot in on_map:
            fix = self._found(shot, self._templates, follow)
            if fix is not None:
                covered = fix.covered if is_first else min(fix.covered, _LITTLE)
                await self._note(shot, replace(fix, covered=covered), self._templates)
                is_first = False
        out: list[Localized | None] = []
        for shot in beyond:
            local = self._odometry.templates
            if local is None:
                break
            fix = self._found(shot, local, follow_own_views)
            if fix is not None:
                await self._note(shot, fix, local)
            out.append(fix)
        making.cancel()
        with suppress(asyncio.CancelledError):
            await making
        self._work.end()
        return out

    async def _note(self, shot: Shot, fix: Localized, seen: Templates) -> None:
        self._odometry.note(shot.frame, fix, seen, _WORLD)
        await self._odometry.settled()

    def _found(self, shot: Shot, templates: Templates, by: _Follows) -> Localized | None:
        prior = predicted(shot.true.retracted(self._off), self._rng)
        fix = by(
            shot.frame.image, self._sensor.camera, self._sensor.body_from_cam, templates,
            prior, None, self._options,
        )  # fmt: skip
        if not isinstance(fix, Localized):
            return None
        self._off = shot.true.local(fix.world_from_body)
        return fix
