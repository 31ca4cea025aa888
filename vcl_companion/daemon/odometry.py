"""Where the swarm's map ends, a drone goes on by its own last frames, until the map is there.

A map is made in seconds and carried over the radio in more; who turns fast is out of its sight by
then. While it still shows where we are, some frames are kept with their poses; when what it shows
becomes little, a local map is made of them (``mapping.local_map``), and of the frames found by
that the next one, and so on. What each adds to the error is told with it (``PoseWindow``).
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import made_or_no_map
from vcl_companion.daemon.workshop import OwnImage
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, log_so3
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_window import PoseWindow
from vcl_companion.mapping.given_depths import SceneDepth
from vcl_companion.mapping.local_map import scene_depth
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.templates import Templates
from vcl_companion.recording.sensor import Sensor

_log = logging.getLogger(__name__)

# Views that a local map is made of, at most and at least, and further ones that its keyframes and
# those of the next one may be among.
_MOST_VIEWS, _LEAST_VIEWS, _N_MORE = 4, 3, 4
# They are so far apart: turned by so much, or moved by such a share of how far the scene is.
_APART_RAD, _APART_SHARE = np.deg2rad(8.0), 0.06
# A local map is made of the two newest, and of others that lie so many times farther apart.
_FAR_APART = 2.2
# A frame that is less than this share of that from the last one brings nothing.
_NEWS = 0.3
# Less of the image than this, and than this share of the most that the map in use has filled:
# what it shows becomes little.
_COVERED, _OF_MOST = 0.65, 0.85
# A local map is asked as well where the swarm's fills less, and believed where it is clearly surer.
_HARDLY_COVERED, _CLEARLY_SURER = 0.4, 0.8
# And not where own frames tell how it is turned so many times better: few patches of the map that
# lie close together tell neither, and are soon wrong.
_TURNED_SURER = 8.0
# A frame that has been lost waits no longer for a local map; the next ones have it.
_BEGUN_WITHIN_S = 0.5
# So far from the newest view of a local map it is made anew: sooner it would show hardly more, and
# each adds to what we are off. Farther while the swarm's map fills more than such a share of the
# image: it takes a tenth of the time that a round's map takes to be built, beside it.
_LEFT_BEHIND, _LEFT_BEHIND_IN_SIGHT, _IN_SIGHT = 0.5, 1.0, 0.5
# Landmarks of a map by which it is told how far its scene is.
_N_FOR_DEPTH = 2000


@dataclass(frozen=True, eq=False)
class _Local:
    """A local map, and the views that it was made of."""

    templates: Templates
    keyframes: list[Frame]


class Odometry:
    """Keeps local maps while they may be needed; see the module.

    Args:
        sensor: of our camera.
        drone_id: our system id.
        work: makes them.
    """

    def __init__(self, sensor: Sensor, drone_id: int, work: MapWork) -> None:
        self._sensor = sensor
        self._drone_id = drone_id
        self._work = work
        self._local: _Local | None = None
        self._window: PoseWindow[Frame] = PoseWindow()
        self._scene: SceneDepth | None = None
        self._world: tuple[bytes, int] = b"", 0
        # By which keyframes, known by their covariance: a map that is left is not kept for this.
        self._most_covered: tuple[Array | None, float] = None, 0.0
        self._begun_with: Frame | None = None
        self._wanted, self._idle = asyncio.Event(), asyncio.Event()
        self._idle.set()

    @property
    def templates(self) -> Templates | None:
        """The local map in use, if there is one."""
        return None if self._local is None else self._local.templates

    def templates_in(self, world: tuple[bytes, int]) -> Templates | None:
        """Return the local map in use, if there is one and its poses are in a world (``note``)."""
        return self.templates if world == self._world else None

    async def begun(self, world: tuple[bytes, int]) -> Templates | None:
        """Return the local map; without one, one of the last frames, made now if it can be.

        For who has been in sight of the swarm's map a frame ago and is not any more; once of the
        same frames.

        Args:
            world: that its poses have to be in; see ``note``.
        """
        newest = self._window.views[-1] if self._window.views else None
        if world != self._world or newest is None:
            return None
        if self._local is None and newest is not self._begun_with:
            self._begun_with = newest
            self._want()
            with suppress(TimeoutError):
                await asyncio.wait_for(self.settled(), _BEGUN_WITHIN_S)
        return self.templates

    def may_tell_more(self, on_map: Localized | NotLocalized) -> bool:
        """Whether the local map is to be asked about a frame, by what the swarm's says of it."""
        if self._local is None:
            return False
        return isinstance(on_map, NotLocalized) or on_map.covered < _HARDLY_COVERED

    def tells_more(self, own: Localized, on_map: Localized | NotLocalized) -> bool:
        """Whether what the local map says of a frame is to be believed, and not the swarm's."""
        if isinstance(on_map, NotLocalized) or self._scene is None:
            return True
        known, by_map = own.covariance(), on_map.covariance()
        vague, vague_on_map = (self._scene.vagueness(c)[0] for c in (known, by_map))
        turned, turned_by_map = (float(np.trace(c[3:, 3:])) for c in (known, by_map))
        return bool(
            vague < _CLEARLY_SURER**2 * vague_on_map or _TURNED_SURER**2 * turned < turned_by_map
        )

    def note(self, frame: Frame, fix: Localized, seen: Templates, world: tuple[bytes, int]) -> None:
        """Take in where a frame was taken; a local map may be made of it.

        Args:
            frame: of ours.
            fix: what it gave.
            seen: what that rests on.
            world: which the pose is in, and how often we have begun in it anew.
        """
        if world != self._world:
            self._world, self._local = world, None
            self._window.clear()
        if not self._add(frame, fix, seen):
            return
        by, most = self._most_covered
        # What one map has filled another one may, or nearly: sky it would not be.
        most = max(fix.covered, most if by is fix.keyframe_covariance else _OF_MOST * most)
        self._most_covered = fix.keyframe_covariance, most
        if fix.covered < min(_COVERED, _OF_MOST * most):
            if self._is_left_behind(fix):
                self._want()
        elif fix.is_on_map:
            self._local = None

    def displaced(self, by: Pose, at: Pose, covariance: Array, world: tuple[bytes, int]) -> None:
        """Go on from where we are in truth: how our own frames lie to each other holds as before.

        They go along, unless the last of them was where the map has put it; see ``PoseWindow``.

        Args:
            by: what the belief was moved by, in the world.
            at: where to.
            covariance: (6, 6) local, of that.
            world: the same world as before, begun in anew.
        """
        if world != (self._world[0], self._world[1] + 1):
            return
        self._window.displace(by, at, covariance)
        self._world, self._local, self._begun_with = world, None, None

    async def run(self) -> None:
        """Make local maps, when they are wanted, until cancelled."""
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            await self._make()
            if not self._wanted.is_set():
                self._idle.set()

    async def settled(self) -> None:
        """Wait until no local map is wanted that has not been made, or cannot be."""
        await self._idle.wait()

    def _want(self) -> None:
        self._idle.clear()
        self._wanted.set()

    async def _make(self) -> None:
        window, scene, world = self._window, self._scene, self._world
        keyframes = self._far_apart()
        if len(keyframes) < _LEAST_VIEWS or scene is None:
            return
        images = [
            OwnImage(frame.captured_at_ns, np.asarray(frame.image), window.pose_of(frame))
            for frame in keyframes
        ]
        covariance = window.covariance_of(keyframes)
        made = await made_or_no_map(
            self._work.local_map(images, covariance, self._drone_id, scene),
            "no map can be made of our own frames",
            "a map of our own frames failed",
        )
        if isinstance(made, NoMap):
            _log.debug("no local map: %s", made.reason)
        elif world == self._world and all(frame in window.views for frame in keyframes):
            window.settle(keyframes, made.placement)
            self._local = _Local(made.templates, keyframes)

    def _far_apart(self) -> list[Frame]:
        """Return the views that a local map is made of, the newest first.

        The two newest show alike; the long way to others says best how far things are. Where none
        are so far away, those that are.
        """
        newest_first, pose_of = self._window.views[::-1], self._window.pose_of
        chosen = newest_first[:2]
        for view in newest_first[2:]:
            if self._apart(pose_of(chosen[-1]), pose_of(view)) >= _FAR_APART:
                chosen.append(view)
        others = [view for view in newest_first if view not in chosen]
        among = [*chosen, *others][:_MOST_VIEWS]
        return [view for view in newest_first if view in among]

    def _add(self, frame: Frame, fix: Localized, seen: Templates) -> bool:
        """Put a frame into the window if it is to be there; whether it is."""
        views, poses = self._window.views, self._window.poses
        if views and frame.captured_at_ns <= views[-1].captured_at_ns:
            return False
        if views and self._apart(poses[-1], fix.world_from_body) < _NEWS:
            return False
        local = self._local
        if not fix.is_on_map and (local is None or seen is not local.templates):
            return False
        self._make_room()
        if fix.is_on_map:
            self._window.add_by_map(frame, fix)
        elif local is not None:
            self._window.add_by_views(frame, fix, local.keyframes)
        # The one before the newest was only kept while it was the newest.
        if len(views) > 2 and self._may_go(views[-2]) and self._apart(*poses[-3:-1]) < 1.0:
            self._window.drop(len(views) - 2)
        camera, step = self._sensor.camera, max(len(seen.anchors.points_world) // _N_FOR_DEPTH, 1)
        where = fix.world_from_body @ self._sensor.body_from_cam
        self._scene = scene_depth(where, camera, seen.anchors.points_world[::step]) or self._scene
        return True

    def _make_room(self) -> None:
        """Drop the oldest frames that may go until one more has its place."""
        views = self._window.views
        while len(views) >= _MOST_VIEWS + _N_MORE:
            self._window.drop(next(i for i, frame in enumerate(views) if self._may_go(frame)))

    def _may_go(self, frame: Frame) -> bool:
        """Whether no local map in use is made of a frame."""
        return self._local is None or frame not in self._local.keyframes

    def _is_left_behind(self, fix: Localized) -> bool:
        """Whether a frame is so far from the local map's newest view that another is to be made."""
        if self._local is None:
            return True
        is_in_sight = fix.is_on_map and fix.covered > _IN_SIGHT
        far = _LEFT_BEHIND_IN_SIGHT if is_in_sight else _LEFT_BEHIND
        newest = self._window.pose_of(self._local.keyframes[0])
        return self._apart(newest, fix.world_from_body) >= far

    def _apart(self, a: Pose, b: Pose) -> float:
        """Return how far two views are apart, as a multiple of what they are to be."""
        moved = a.inverse() @ b
        turned_rad = float(np.linalg.norm(log_so3(moved.rotation)))
        nearness = 0.0 if self._scene is None else self._scene.typical
        share = float(np.linalg.norm(moved.translation)) * nearness
        return float(max(turned_rad / _APART_RAD, share / _APART_SHARE))
