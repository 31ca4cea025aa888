"""Valid messages and blobs of every kind, made by the project's own encoders."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sitl.torture.dice import Dice
from sitl.torture.frames import Payload
from sitl.wall import CAMERA, SENSOR, Scene
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.mapping.keyframe_image import IMAGE_FORMATS, encode_image
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.chunks import MAX_CHUNKS, Reply, TransferStatus, receiving_statuses
from vcl_companion.wire.frame_codec import FrameAnswer, encode_frame
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.map_part import encode_map_part
from vcl_companion.wire.map_update import (
    encode_map_update,
    images_in_update,
    name_of_image,
    without_images,
)
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    PoseRequest,
    encode_pose_request,
)
from vcl_companion.wire.tunnel import encode_payload

_N_TAGS, _N_NUMBERS, _N_NEXT = 16, 4, 4
_CAMERAS = (
    CAMERA,
    CAMERA,
    CAMERA,
    Camera(40, 36, 41.5, 40.0, 19.5, 17.0, "radial-tangential", (-0.28, 0.07, 0.0, 0.0)),
    Camera(33, 64, 30.0, 31.0, 16.0, 32.0, "radial-tangential", (-0.3, 0.1, 0.0, 0.0, 0.01)),
    Camera(48, 48, 25.7, 26.0, 24.0, 24.0, "equidistant", (-0.01, 0.04, -0.04, 0.007)),
    Camera(1, 1, 1.0, 1.0, 0.0, 0.0),
    Camera(2048, 2048, 900.0, 900.0, 1000.0, 1000.0),
)
_REASONS = ("nothing was seen", "ü" * 45, "x" * 90, "?")


@dataclass
class Overheard:
    """What peers know of the drone that they torture: what it has said, and its map.

    Attributes:
        tags: of what it was sending lately.
        wanted: numbers of its latest requests for frames.
        asked: numbers of its latest requests for a pose.
        stored: the map that it flies on.
    """

    tags: deque[int] = field(default_factory=lambda: deque(maxlen=_N_TAGS))
    wanted: deque[int] = field(default_factory=lambda: deque(maxlen=_N_NUMBERS))
    asked: deque[int] = field(default_factory=lambda: deque(maxlen=_N_NUMBERS))
    stored: StoredMap | None = None


class Valid:
    """Makes valid payloads and blobs, half of them such as the drone has a use for.

    Args:
        dice: decides what.
        peers: who sends them; the first coordinates, if the drone itself does not.
        heard: of the drone.
    """

    def __init__(self, dice: Dice, peers: tuple[int, ...], heard: Overheard) -> None:
        self._dice = dice
        self._heard = heard
        self.scene = Scene(dice.rng)
        self._images = [
            self.scene.encoded(self.scene.place(), image_format)
            for image_format in IMAGE_FORMATS
            for _ in range(4)
        ]
        first = encode_map(self.scene.first_map(peers))
        self._first_maps = [first, encode_map(self.scene.first_map(peers[:2]))]
        self._next_of = b""
        self._next_maps: list[tuple[bytes, bytes]] = []
        self._messages: tuple[Callable[[int], Payload], ...] = (
            self._status, self._status, self._frame_request, self._state, self._state,
            self._refused, self._proposal, self._proposal, self._pose_refused,
        )  # fmt: skip
        self._blobs: tuple[Callable[[int], tuple[BlobKind, bytes]], ...] = (
            self._frame_answer, self._frame_answer, self._frame_answer, self._passed_frame,
            self._passed_frame, self._pose_request, self._pose_request, self._whole_map,
            self._odd_map, self._odd_map, self._part, self._update, self._update,
            self._standalone,
        )  # fmt: skip

    def message(self, peer: int) -> Payload:
        """Return one that fits a payload, but no chunk."""
        return self._dice.pick(self._messages)(peer)

    def blob(self, peer: int) -> tuple[BlobKind, bytes]:
        """Return one that travels in chunks."""
        return self._dice.pick(self._blobs)(peer)

    def _number(self, numbers: deque[int]) -> int:
        """Return one of some numbers, mostly the last, or any."""
        dice = self._dice
        if not numbers or dice.below(5) == 0:
            return dice.word()
        return numbers[-1] if dice.below(2) else dice.pick(numbers)

    def _revision(self) -> bytes:
        stored = self._heard.stored
        if stored is not None and self._dice.below(4):
            return stored.revision
        return self._dice.rng.bytes(8)

    def _status(self, _: int) -> Payload:
        dice = self._dice
        tag, ask = self._number(self._heard.tags), 1 + dice.below(127)
        match dice.below(5):
            case 0:
                status = TransferStatus(tag, Reply.COMPLETE, ask, digest=dice.rng.bytes(8))
            case 1:
                reply = dice.pick((Reply.BUSY, Reply.BUSY, Reply.TOO_LARGE, Reply.CORRUPT))
                status = TransferStatus(tag, reply, ask)
            case _:
                most = dice.pick((4, 20, 200, MAX_CHUNKS))
                cuts = sorted({dice.below(most) for _ in range(2 + dice.below(12))})
                ranges = list(zip(cuts[:-1:2], cuts[1::2], strict=False))
                status = dice.pick(list(receiving_statuses(tag, ask, cuts[-1] + 1, ranges)))
        return encode_payload(status)

    def _frame_request(self, _: int) -> Payload:
        age_s = self._dice.pick((0.0, 0.1, 1.0, 3600.0))
        at_ns = self._dice.pick((0, 1_000_000_000, self._dice.word(), (1 << 63) - 1))
        return encode_payload(FrameRequest(self._dice.word(), at_ns, age_s))

    def _state(self, _: int) -> Payload:
        dice = self._dice
        revision = b"" if dice.below(6) == 0 else self._revision()
        n_landmarks = dice.below(32_769) if revision else 0
        return encode_payload(
            MapState(revision, n_landmarks, dice.chance(0.8), dice.below(65_536), dice.chance(0.3))
        )

    def _refused(self, _: int) -> Payload:
        return encode_payload(MapRefused(self._dice.word(), self._dice.pick(_REASONS)))

    def _pose_refused(self, _: int) -> Payload:
        number = self._number(self._heard.asked)
        return encode_payload(PoseRefused(number, self._dice.pick(_REASONS)))

    def _proposal(self, _: int) -> Payload:
        root = self._dice.rng.normal(0.0, 0.1, (6, 6))
        pose = self._pose(self._dice.pick((0.1, 5.0, 30_000.0)))
        number = self._number(self._heard.asked)
        return encode_payload(PoseProposal.of(number, self._revision(), pose, root @ root.T))

    def _pose(self, size_m: float) -> Pose:
        turn, position = self._dice.rng.uniform(-1.0, 1.0, (2, 3))
        return Pose(exp_so3(turn), size_m * position)

    def frame(self, peer: int) -> FrameAnswer:
        """Return a frame of a peer's."""
        dice = self._dice
        camera = CAMERA if dice.below(4) else dice.pick(_CAMERAS)
        is_odd = camera is not CAMERA and camera.width_px < 100
        image = _blank(camera) if is_odd and dice.below(2) else dice.pick(self._images)
        attitude = self._pose(0.0).quaternion() if dice.below(3) else None
        frame = FrameAnswer(
            drone_id=peer if dice.below(8) else 1 + dice.below(255),
            request_id=self._number(self._heard.wanted),
            captured_at_ns=dice.word() << dice.below(31),
            frame_age_s=dice.pick((0.0, 0.05, 0.5, 3600.0)),
            ned_from_body=attitude,
            body_from_cam=SENSOR.body_from_cam if dice.below(4) else self._pose(0.3),
            camera=camera,
            image_bytes=image,
            world_from_body=self._pose(1.0) if dice.below(2) else None,
        )
        tells = frame.world_from_body is not None and dice.below(2)
        return replace(frame, seen=self._seen()) if tells else frame

    def _seen(self) -> SeenLandmarks:
        """Return what a frame may show of the map in use, or of none."""
        stored, rng = self._heard.stored, self._dice.rng
        n_landmarks = self._dice.pick((1, 500)) if stored is None else stored.n_landmarks
        n_seen = min(1 + self._dice.below(400), n_landmarks)
        landmarks = np.sort(rng.choice(n_landmarks, n_seen, replace=False))
        aside_px = np.clip(rng.normal(0.0, self._dice.pick((0.1, 3.0)), (n_seen, 2)), -4.0, 4.0)
        return SeenLandmarks(self._revision(), landmarks, aside_px)

    def _frame_answer(self, peer: int) -> tuple[BlobKind, bytes]:
        return BlobKind.FRAME_ANSWER, encode_frame(self.frame(peer))

    def _passed_frame(self, peer: int) -> tuple[BlobKind, bytes]:
        return BlobKind.PASSED_FRAME, encode_frame(self.frame(peer), BlobKind.PASSED_FRAME)

    def _pose_request(self, peer: int) -> tuple[BlobKind, bytes]:
        request = PoseRequest(self._revision(), self.frame(peer))
        return BlobKind.POSE_REQUEST, encode_pose_request(request)

    def _whole_map(self, peer: int) -> tuple[BlobKind, bytes]:
        stored = self._heard.stored
        if stored is None or len(stored.index.landmark_map.keyframes) > 6 or self._dice.below(2):
            return BlobKind.MAP, self._dice.pick(self._first_maps)
        return BlobKind.MAP, self._next_map(peer)[0]

    def _odd_map(self, peer: int) -> tuple[BlobKind, bytes]:
        """Return a map in which nothing fits together: what a codec takes, not what flies."""
        rng = self._dice.rng
        n_landmarks, n_keyframes = self._dice.pick(((0, 1), (3, 2), (30, 3), (9, 5)))
        keyframes = tuple(self._odd_keyframe(peer) for _ in range(n_keyframes))
        sizes = np.array([(k.camera.width_px, k.camera.height_px) for k in keyframes])
        seen = rng.uniform(0.0, 1.0, (n_landmarks, n_keyframes, 2)) * (sizes - 1)
        seen[rng.uniform(size=(n_landmarks, n_keyframes)) > 0.7] = np.nan
        root = rng.normal(0.0, 0.01, (6, 6))
        odd = LandmarkMap(
            keyframes,
            rng.uniform(-30.0, 30.0, (n_landmarks, 3)),
            seen,
            float(rng.uniform(0.05, 2.0)),
            self._dice.pick((("akaze",), ("sift",), ("akaze", "sift"), ("orb",))),
            (),
            rng.bytes(8) if self._dice.below(2) else b"",
            root @ root.T if self._dice.below(2) else np.zeros((6, 6)),
        )
        return BlobKind.MAP, encode_map(odd)

    def _odd_keyframe(self, peer: int) -> Keyframe:
        image = self._dice.pick(self._images) if self._dice.below(3) else self._dice.rng.bytes(20)
        camera = self._dice.pick(_CAMERAS)
        at_ns = self._dice.word()
        return Keyframe(peer, at_ns, self._pose(5.0), SENSOR.body_from_cam, camera, image)

    def _part(self, peer: int) -> tuple[BlobKind, bytes]:
        """Return a map as if it were a part of another."""
        _, data = self._odd_map(peer) if self._dice.below(2) else self._whole_map(peer)
        return BlobKind.MAP_PART, encode_map_part(self._dice.rng.bytes(8), data)

    def _update(self, peer: int) -> tuple[BlobKind, bytes]:
        """Return an update of the drone's map, every third time one that leaves an image out."""
        data, update = self._next_map(peer)
        if self._dice.below(3) == 0:
            last = decode_map(data).keyframes[-1].image_bytes
            update = without_images(update, {name_of_image(last)})
        return BlobKind.MAP_UPDATE, update

    def _standalone(self, peer: int) -> tuple[BlobKind, bytes]:
        """Return a map for one who has not its parent, all images in it, one, or none."""
        make = self._dice.pick((self._whole_map, self._odd_map))
        update = encode_map_update(make(peer)[1], None)
        names = sorted(images_in_update(update))
        return BlobKind.MAP_UPDATE, without_images(update, names[: self._dice.below(3) * 2])

    def _next_map(self, peer: int) -> tuple[bytes, bytes]:
        """Return a map that goes on from the drone's, and its update; one of a few."""
        stored = self._heard.stored
        data = self._first_maps[0] if stored is None else stored.data
        if self._next_of != data:
            self._next_of = data
            self._next_maps.clear()
        if len(self._next_maps) < _N_NEXT:
            parent = decode_map(data) if stored is None else stored.index.landmark_map
            child = encode_map(self.scene.next_map(parent, revision_of(data), peer))
            self._next_maps.append((child, encode_map_update(child, parent)))
        return self._dice.pick(self._next_maps)


@functools.cache
def _blank(camera: Camera) -> bytes:
    """Return an image of a camera's own size in which nothing can be found."""
    grey = np.full((camera.height_px, camera.width_px), 90, dtype=np.uint8)
    return encode_image(grey, 50)
