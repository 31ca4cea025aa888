"""What place we see, as peers are told it: by a signature of our newest frame, now and then."""

from __future__ import annotations

import asyncio

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.swarm.group import Group

_EVERY_S = 2.0


async def keep_place_known(group: Group, frames: FrameHistory, work: MapWork) -> None:
    """Have peers know what place we see; returns at once where there are none, else never.

    Args:
        group: tells them with our state.
        frames: our own.
        work: makes the signatures.
    """
    seen: Frame | None = None
    while group.peers:
        await asyncio.sleep(_EVERY_S)
        newest = frames.newest
        if newest is None or newest is seen:
            continue
        seen = newest
        signature = await work.signature(np.asarray(newest.image))
        group.note_signature(signature, asyncio.get_running_loop().time())
