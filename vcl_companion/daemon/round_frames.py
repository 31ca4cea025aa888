"""What a round is made of: our own frames, encoded while those of the others come."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.gathering import Gathering, Wanted
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.wire.frame_codec import FrameAnswer

_log = logging.getLogger(__name__)


class RoundFrames:
    """Gathers every drone's frames of one instant, ours too; one round after the other.

    Args:
        group: who we are.
        frames: our own.
        describe: makes the answer that a peer would give of one of our frames.
        gathering: asks the others for theirs.
        passed: sends the frames of an update on while it is built.
    """

    def __init__(
        self,
        group: Group,
        frames: FrameHistory,
        describe: Callable[[Frame, int], Awaitable[FrameAnswer]],
        gathering: Gathering,
        passed: PassedFrames,
    ) -> None:
        self._group = group
        self._frames = frames
        self._describe = describe
        self._gathering = gathering
        self._passed = passed
        self._passes_on = False

    def begin(self) -> int:
        """Begin a round and return its request id; what is still open of the last one is not."""
        return self._gathering.begin()

    def take(self, peer: int, frame: FrameAnswer) -> str | None:
        """Take a peer's frame; return why it is refused, if it is."""
        refusal = self._gathering.take(peer, frame)
        if refusal is None and self._passes_on:
            self._passed.pass_on_answer(frame)
        return refusal

    async def gathered(
        self, newest: Frame, wanted: Wanted, is_over: Callable[[], bool], *, passes_on: bool
    ) -> list[FrameAnswer] | NoMap:
        """Return our own frames and those of the others, or why ours cannot be used.

        Args:
            newest: our own frame that the round begins with.
            wanted: what is asked of whom; of us it is that frame, and as many more as of others.
            is_over: whether the round is in vain by now.
            passes_on: whether all are sent what comes: they will need the images of an update.
        """
        if passes_on:
            self._passed.over()
        self._passes_on = passes_on
        try:
            return await self._of_all(newest, wanted, is_over)
        finally:
            self._passes_on = False

    async def _of_all(
        self, newest: Frame, wanted: Wanted, is_over: Callable[[], bool]
    ) -> list[FrameAnswer] | NoMap:
        began_s = asyncio.get_running_loop().time()
        async with asyncio.TaskGroup() as both:
            ours = both.create_task(self._own(newest, wanted))
            theirs = both.create_task(self._gathering.gather(wanted, is_over))
        described = ours.result()
        if isinstance(described, NoMap):
            return described
        if self._passes_on:
            # Not before the others' have come: on a radio they would come too late beside it.
            for answer in described:
                self._passed.pass_on(answer)
        gathered = described + theirs.result()
        took_s = asyncio.get_running_loop().time() - began_s
        # Alone we try for a first map again and again.
        is_news = self._passes_on or len(gathered) > 1
        level = logging.INFO if is_news else logging.DEBUG
        _log.log(level, "%d frames gathered in %.1f s", len(gathered), took_s)
        return gathered

    async def _own(self, newest: Frame, wanted: Wanted) -> list[FrameAnswer] | NoMap:
        """Return our own frames as peers would answer, the latest first."""
        own = [newest]
        for n in range(1, 1 + wanted.earlier.get(self._group.own_id, 0)):
            earlier = self._frames.nearest(wanted.instant_ns(n))
            if earlier is not None and earlier not in own:
                own.append(earlier)
        try:
            return [await self._describe(f, self._gathering.request_id) for f in own]
        except ValueError as error:
            return NoMap(f"our own frame: {error}")
