"""From frame to pose: the straight line that everything else only feeds."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from vcl_companion.cameras.source import CameraSource, Frame
from vcl_companion.daemon.catching_up import CatchingUp
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import Basis, PoseSource
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.frame_waits import FrameWaits
from vcl_companion.daemon.frozen_camera import FrozenCamera
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.jump_witness import Unwitnessed
from vcl_companion.daemon.mailbox import FramesBehind, Mailbox
from vcl_companion.daemon.map_search import MapSearch, Sought
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.daemon.peer_poses import AskedPeers, PeerPoses
from vcl_companion.daemon.teller import Teller
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized

_log = logging.getLogger(__name__)

# How long the last frames of a stream may take.
_LAST_FRAMES_S = 5.0
# A third of a megabyte each.
_MAX_BEHIND = 16
_FROZEN = "the camera gives the same image again"


class Companion:
    """Takes the newest frame, localizes it, sends the pose; one frame at a time.

    A frame that has to be looked for by its features takes as long as ten others: it is, and
    is answered, beside those that follow it. These are followed from where it was, one after
    the other up to the newest: by then that one is too far from it to be found at once.

    Args:
        camera: where frames come from.
        outcomes: where each is answered.
        own_fixes: what each shows by itself.
        catching_up: follows those that were lost when a map has come.
        peer_poses: what peers say of it.
        teller: tells the autopilot poses.
        maps: the current map.
        estimator: what is believed of the pose.
        on_frame: shown every frame as it arrives (the exchange keeps some for peers).
        health: told while a frame waits for a map.
        work: searches the map for a frame that patches do not place, beside the others.
        frame_wait_s: how long a frame that the map does not know waits for the next
            map, which it may have gone into itself, while no newer frame comes.
    """

    def __init__(
        self,
        camera: CameraSource,
        outcomes: FrameOutcomes,
        own_fixes: OwnFixes,
        catching_up: CatchingUp,
        peer_poses: PeerPoses,
        teller: Teller,
        maps: MapStore,
        estimator: Estimator,
        on_frame: Callable[[Frame], None],
        health: Health,
        work: MapWork,
        frame_wait_s: float,
    ) -> None:
        self._camera = camera
        self._outcomes = outcomes
        self._own_fixes = own_fixes
        self._catching_up = catching_up
        self._peer_poses = peer_poses
        self._teller = teller
        self._maps = maps
        self._estimator = estimator
        self._on_frame = on_frame
        self._health = health
        self._frozen = FrozenCamera(own_fixes.attitude_at, estimator.predicted)
        self._mailbox = Mailbox()
        self._waits = FrameWaits(self._mailbox, maps, health, frame_wait_s)
        self._map_search = MapSearch(self._mailbox, maps, estimator, work)
        self._behind: FramesBehind[NotLocalized] = FramesBehind(_MAX_BEHIND)

    async def read_camera(self) -> None:
        """Move frames from the camera to the mailbox until the stream ends and all are answered.

        A frame that still waits for a first map then is answered at once, one
        that is being localized when that is done. One that is the last one again is none.
        """
        async for frame in self._camera.frames():
            self._outcomes.opened(frame)
            if await self._frozen.has_given(frame):
                at_ns = frame.captured_at_ns
                self._own_fixes.take_nothing(frame, await self._own_fixes.attitude_at(at_ns))
                self._give_up(frame, NotLocalized(_FROZEN))
                continue
            self._teller.arrived(frame.captured_at_ns)
            replaced = self._mailbox.put(frame)
            if replaced is not None:
                self._drop(replaced)
            self._on_frame(frame)
        _log.info("the camera's stream is over")
        self._waits.stream_is_over()
        await self._outcomes.all_answered(_LAST_FRAMES_S)

    async def run(self) -> None:
        """Localize frames until cancelled."""
        async with asyncio.TaskGroup() as beside:
            beside.create_task(self._teller.run())
            beside.create_task(self._catching_up.run())
            beside.create_task(self._own_fixes.run())
            while True:
                await self._take_next(beside)

    async def _take_next(self, beside: asyncio.TaskGroup) -> None:
        """Localize the next frame; what is left to do for it is done beside those after it."""
        frame = await self._mailbox.take()
        stored = self._maps.current or await self._first_map(frame)
        if stored is None:
            return
        left = await self._localize(frame, stored)
        if left is not None:
            beside.create_task(self._finish(left))

    async def _first_map(self, frame: Frame) -> StoredMap | None:
        """Wait for a first map as long as no newer frame comes; answer the frame if none does."""
        await self._waits.first_map(frame)
        if self._maps.current is None:
            self._own_fixes.take_nothing(frame, None)
            self._outcomes.refuse(frame, self._waits.no_map())
        return self._maps.current

    async def _localize(self, frame: Frame, stored: StoredMap) -> Sought | AskedPeers | None:
        """Localize a frame by the map, and answer it unless features or peers are asked as well.

        Returns:
            What they are asked; None when nobody is and the frame is answered.
        """
        look = await self._own_fixes.look(frame, stored)
        stored, fix, ned_from_body = look.stored, look.fix, look.ned_from_body
        follows = stored.templates is not None
        refused = self._take(frame, fix, ned_from_body)
        if refused is None:
            self._own_fixes.note(frame, look)
        if isinstance(fix, Localized) or not follows:
            self._estimator.in_sight.seen_on = stored.revision
        if isinstance(fix, NotLocalized) and follows:
            if self._catching_up.is_under_way and await self._is_led(frame, self._catching_up):
                return await self._localize(frame, self._maps.current or stored)
            search = self._map_search
            if search.is_under_way:
                if await self._is_led(frame, search):
                    return await self._localize(frame, self._maps.current or stored)
            elif search.is_due(stored, look.began_at_s):
                return search.begin(frame, ned_from_body, stored, look.began_at_s)
        return await self._ask(frame, ned_from_body, stored, refused)

    async def _is_led(self, frame: Frame, leading: CatchingUp | MapSearch) -> bool:
        """Wait until older frames are looked for no more; whether what was found leads this one.

        That is if it is still the newest then.
        """
        await self._waits.unless_newer(frame, leading.ended())
        return not (leading.is_under_way or self._mailbox.has_had_newer(frame))

    async def _search(self, sought: Sought) -> AskedPeers | Sought | None:
        """Look for a frame by its features; the rest is as for any other.

        What comes meanwhile is kept, and followed from where this one is found.
        """
        frame = sought.frame
        try:
            stored, fix = await self._map_search.found(sought)
            refused = self._take(frame, fix, sought.ned_from_body)
            self._estimator.in_sight.seen_on = stored.revision
            while refused is None and (behind := self._behind.take()) is not None:
                await self._look_again(*behind)
        finally:
            self._map_search.end()
            while (behind := self._behind.take()) is not None:
                self._give_up(*behind)
        return await self._ask(frame, sought.ned_from_body, stored, refused)

    async def _look_again(self, frame: Frame, refused: NotLocalized) -> None:
        """Answer a frame by what is known by now of where it was taken: later ones have been."""
        if not await self._is_placed_by_patches(frame):
            self._give_up(frame, refused)

    async def _is_placed_by_patches(self, frame: Frame) -> bool:
        """Look at a frame once more, from where it is believed by now; answer it if that helps."""
        look = await self._own_fixes.look_by_patches(frame)
        if look is None or isinstance(look.fix, NotLocalized):
            return False
        if self._take(frame, look.fix, look.ned_from_body) is not None:
            return False
        self._outcomes.close(frame)
        return True

    async def _ask(
        self,
        frame: Frame,
        ned_from_body: Array | None,
        stored: StoredMap,
        refused: NotLocalized | None,
    ) -> Sought | AskedPeers | None:
        """Answer a frame that has been looked at, unless peers are asked about it.

        Nor are they while the search of an older frame, which will lead this one, has only begun,
        or where they would see what the frame's own fix was refused for.
        """
        if isinstance(refused, Unwitnessed):
            self._give_up(frame, refused)
            return None
        now_s = asyncio.get_running_loop().time()
        is_sought = self._estimator.in_sight.is_being_sought(now_s)
        is_led = refused is not None and self._map_search.is_behind(frame) and is_sought
        if not is_led:
            asked = self._peer_poses.begin(frame, ned_from_body, stored, refused)
            if asked is not None:
                return asked
        if refused is None:
            self._outcomes.close(frame)
            return None
        return await self._given_up(frame, stored, refused)

    async def _given_up(
        self, frame: Frame, stored: StoredMap | None, refused: NotLocalized
    ) -> Sought | AskedPeers | None:
        """Answer a frame that nobody could place, unless something comes that may place it.

        That is a newer map, or, where an older frame is still looked for, its place.
        """
        if self._map_search.is_behind(frame):
            for let_go in self._behind.keep(frame, refused):
                self._give_up(*let_go)
            return None
        self._health.refused(refused.reason)
        newer = await self._waits.next_map(frame, stored)
        if newer is not None:
            return await self._localize(frame, newer)
        if self._mailbox.has_had_newer(frame):
            await self._look_again(frame, refused)
        else:
            self._give_up(frame, refused)
        return None

    def _take(
        self, frame: Frame, fix: Localized | NotLocalized, ned_from_body: Array | None
    ) -> NotLocalized | None:
        """Bring the state up to what the frame gave and send it; or say why there is nothing."""
        if isinstance(fix, NotLocalized):
            self._own_fixes.take_nothing(frame, ned_from_body)
            return fix
        state = self._own_fixes.take(frame, fix, ned_from_body)
        if isinstance(state, NotLocalized):
            return state
        return self._send(frame, state, "intra", fix.by, fix.n_matched, fix.n_inliers)

    async def _finish(self, left: Sought | AskedPeers | None) -> None:
        """Do what is left to do for a frame, beside the frames that follow it."""
        while isinstance(left, Sought):
            left = await self._search(left)
        if left is not None:
            await self._hear_peers(left)

    async def _hear_peers(self, asked: AskedPeers) -> None:
        """Fuse what peers say of a frame, answer it, and fuse what comes too late for that."""
        frame, refused, again = asked.frame, asked.refused, None
        state = await self._peer_poses.hear(asked)
        if refused is None:
            self._outcomes.close(frame, None if state is None else "fused")
        elif state is None:
            again = await self._given_up(frame, asked.stored(), refused)
        elif await self._is_placed_by_patches(frame):
            pass  # led by what peers said, the frame's own patches tell it more closely
        elif self._maps.has_left_world(asked.world):
            self._give_up(frame, NotLocalized("peers told a place in a world that was left since"))
        else:
            unsent = self._send(frame, state, "inter", "peer")
            if unsent is None:
                self._outcomes.close(frame)
            else:
                self._outcomes.refuse(frame, unsent)
        await self._finish(again)
        await self._peer_poses.hear_late(asked)

    def _send(
        self,
        frame: Frame,
        state: FilterState,
        source: PoseSource,
        by: Basis,
        n_matched: int = 0,
        n_inliers: int = 0,
    ) -> NotLocalized | None:
        """Send the pose of a frame, at its own time; or say why it cannot be."""
        untold = self._teller.tell(state, frame.captured_at_ns)
        if untold is not None and not untold.is_held_back:
            return NotLocalized(untold.reason, n_matched, n_inliers)
        held_back = untold.reason if untold else ""
        self._outcomes.sent(frame, source, by, n_matched, n_inliers, held_back)
        return None

    def _give_up(self, frame: Frame, why: NotLocalized) -> None:
        """Refuse a frame; while the last fix is fresh, attitude and motion still say where it is.

        Not when the autopilot has heard of a later frame: a pose of the past that
        nobody has measured is no news.
        """
        at_ns = frame.captured_at_ns
        state = self._estimator.coasted_at(at_ns)
        coasted = state is not None and self._teller.tell(state, at_ns) is None
        self._outcomes.refuse(frame, why, coasted=coasted)

    def _drop(self, frame: Frame) -> None:
        """Answer a frame whose place a newer one took before it was looked at."""
        if self._maps.current is None:
            self._outcomes.refuse(frame, self._waits.no_map())
        else:
            self._outcomes.drop(frame)
