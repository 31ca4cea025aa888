"""The frames of a round at those who did not take them, while the map is still being built.

Images are most of an update's bytes, and known before it is. Where all hear what one sends,
a member's answer goes to all of them; else the coordinator passes it on as it comes, as it
does with its own. They are with everybody when the map is made: what has to wait for that,
poses and landmarks, is a third.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from vcl_companion.daemon.held_images import HeldImages
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.swarm.group import Group
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame, encode_frame
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.map_update import name_of_image

_log = logging.getLogger(__name__)

# Frames whose features are still to be found, also of one drone; blobs whose images are known by
# name.
_N_NEW, _N_NEW_OF_ONE, _N_NAMES = 48, 24, 48
# What a sender takes a peer to hold, which has its own among them: fewer than are held.
_N_KNOWN_HELD = 40
# So many pixels of a drone's frames are looked at in so long: 27 of 640 x 480, 2 of the largest,
# three seconds' work. Rounds have some of them a second; whoever sends more keeps no map waiting.
_LOOKED_AT_PX, _LOOKED_AT_S = 1 << 23, 8.0
# What was said of blobs that are not here, or not yet.
_N_SAID = 256


@dataclass
class _AtPeer:
    """Names of the images that a peer holds, and of those on their way, by transfer."""

    held: deque[bytes] = field(default_factory=lambda: deque(maxlen=_N_KNOWN_HELD))
    on_their_way: dict[int, bytes] = field(default_factory=dict)


class PassedFrames:
    """Passes frames on as the coordinator, and holds their images as a member.

    Args:
        group: who is there.
        hand: sends a frame to a peer; returns the transfer's id.
        cancel: ends a transfer, one that is over already too.
        work: finds the features of what has come: a map with this image will need them.
        all_hear: whether members' answers go to everybody.
    """

    def __init__(
        self,
        group: Group,
        hand: Callable[[int, bytes], int],
        cancel: Callable[[int], None],
        work: MapWork,
        all_hear: Callable[[], bool],
    ) -> None:
        self._group = group
        self._hand = hand
        self._cancel = cancel
        self._all_hear = all_hear
        self._work = work
        self._peers: dict[int, _AtPeer] = {}
        self._held = HeldImages()
        self._names: dict[bytes, bytes] = {}  # of the images of answers, by their blobs' digests
        self._said: deque[tuple[int, bytes]] = deque(maxlen=_N_SAID)
        self._new: asyncio.Queue[FrameAnswer] = asyncio.Queue(_N_NEW)
        self._n_new: Counter[int] = Counter()  # of these, of each drone
        self._looked_at: dict[int, deque[tuple[float, int]]] = {}  # when, px; of each drone

    @property
    def held(self) -> Mapping[bytes, bytes]:
        """Images that are here, by their names."""
        return self._held.by_name

    def hold(self, frame: FrameAnswer) -> None:
        """Hold the image of a frame that was given to a peer: by us, or by a member we heard."""
        self._held.keep(frame.drone_id, frame.image_bytes)
        self._look_at(frame)

    def take(self, blob: bytes) -> None:
        """Hold the image of a frame that the coordinator has passed on.

        Raises:
            WireError: it is no frame.
        """
        self.hold(decode_frame(blob, BlobKind.PASSED_FRAME))

    def answered(self, frame: FrameAnswer, digest: bytes) -> None:
        """Note what a member has given to us, and perhaps to others, in a blob."""
        self._names[digest] = name = name_of_image(frame.image_bytes)
        self._peers.setdefault(frame.drone_id, _AtPeer()).held.append(name)
        while len(self._names) > _N_NAMES:
            del self._names[next(iter(self._names))]
        said, self._said = self._said, deque(maxlen=_N_SAID)
        for peer, other in said:
            self.is_held(peer, other)

    def is_held(self, peer: int, digest: bytes) -> None:
        """Note that a peer says to have a blob whole."""
        name = self._names.get(digest)
        if name is None:
            self._said.append((peer, digest))
        else:
            self._peers.setdefault(peer, _AtPeer()).held.append(name)

    async def run(self) -> None:
        """Find the features of what goes round, before the map needs them, until cancelled."""
        while True:
            frame = await self._new.get()
            self._n_new[frame.drone_id] -= 1
            if not self._may_look_at(frame):
                continue
            try:
                await self._work.look_at(frame)
            except ValueError as error:
                _log.debug("a frame of drone %d: %s", frame.drone_id, error)
            except Exception:
                # A peer's image went in: it may not end the flight.
                _log.exception("a frame of drone %d cannot be looked at", frame.drone_id)

    def pass_on_answer(self, frame: FrameAnswer) -> None:
        """Pass a member's frame on, unless all have heard it."""
        if not self._all_hear():
            self.pass_on(frame)

    def pass_on(self, frame: FrameAnswer) -> None:
        """Send a frame of a round to every member that neither took it nor coordinates.

        Not to one that flies on a map of its own until that is in ours.
        """
        self._look_at(frame)
        name = name_of_image(frame.image_bytes)
        blob = b""
        for peer in self._group.teammates:
            if peer == self._group.own_id:
                continue
            there = self._peers.setdefault(peer, _AtPeer())
            state = self._group.state_of(peer)
            if peer == frame.drone_id:
                there.held.append(name)
            elif self._group.is_apart(peer) or (state is not None and not state.revision):
                continue  # it has no map that an update could be of: that comes first
            elif name not in there.held and name not in there.on_their_way.values():
                try:
                    blob = blob or encode_frame(replace(frame, seen=None), BlobKind.PASSED_FRAME)
                except ValueError as error:  # where no pose can be told any more, say
                    _log.warning("a frame of drone %d is not passed on: %s", frame.drone_id, error)
                    return
                there.on_their_way[self._hand(peer, blob)] = name

    def ended(self, peer: int, transfer_id: int, *, delivered: bool) -> None:
        """Note that a transfer to a peer is over, one of ours or any other."""
        there = self._peers.get(peer)
        name = None if there is None else there.on_their_way.pop(transfer_id, None)
        if there is not None and name is not None and delivered:
            there.held.append(name)

    def held_by(self, peer: int) -> frozenset[bytes]:
        """Return the names of the images that a peer holds."""
        there = self._peers.get(peer)
        return frozenset() if there is None else frozenset(there.held)

    def on_their_way_to(self, peer: int) -> frozenset[bytes]:
        """Return the names of the images that a peer is being sent."""
        there = self._peers.get(peer)
        return frozenset() if there is None else frozenset(there.on_their_way.values())

    def forgot(self, peer: int) -> None:
        """Note that a peer may hold nothing any more: it was restarted, or away."""
        self._stop(self._peers.pop(peer, None))
        self._said = deque((one for one in self._said if one[0] != peer), _N_SAID)

    def over(self) -> None:
        """Stop what is on its way, and forget who holds what: there is no map that needs it."""
        for there in self._peers.values():
            self._stop(there)
        self._peers.clear()

    def _look_at(self, frame: FrameAnswer) -> None:
        if self._n_new[frame.drone_id] < _N_NEW_OF_ONE and not self._new.full():
            self._n_new[frame.drone_id] += 1
            self._new.put_nowait(frame)

    def _may_look_at(self, frame: FrameAnswer) -> bool:
        """Whether a drone's frames have not had their share of the work yet; note this one."""
        now_s = asyncio.get_running_loop().time()
        n_px = frame.camera.width_px * frame.camera.height_px
        lately = self._looked_at.setdefault(frame.drone_id, deque())
        while lately and lately[0][0] <= now_s - _LOOKED_AT_S:
            lately.popleft()
        if sum(px for _, px in lately) + n_px > _LOOKED_AT_PX:
            return False
        lately.append((now_s, n_px))
        return True

    def _stop(self, there: _AtPeer | None) -> None:
        for transfer_id in there.on_their_way if there is not None else ():
            self._cancel(transfer_id)
