"""Maps begun at an instant of a recording and extended from there, by the daemons' own workshop."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sitl.consistency.alone import Shot, found_alone, predicted
from sitl.daemon_config import exactness
from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, quaternion_from_matrix
from vcl_companion.localization.detail import Detail, needed_detail
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.tracking import TrackingOptions, track
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.recording import Drone, Recording
from vcl_companion.recording.images import load_image
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.vision.features import FeatureOptions, Image
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.header import BlobKind

_PIPELINE = PipelineOptions(FeatureOptions(), LocalizationOptions(), TrackingOptions())
_UPDATES = UpdateOptions()
_ATTITUDE_DEG = 0.3
# For so long before a map's end its frames are followed on it, to go on by them.
_BEFORE_S = 4.0
# Frames of drones that lie no further apart than this share of a period are of one instant.
_AT_ONCE = 0.5
_MOST_BYTES = 1 << 20


@dataclass(frozen=True, eq=False)
class Look:
    """A frame of a drone, and what was found of it on a map.

    Attributes:
        drone: index in the recording.
        revision: how many times the map had been extended.
        true: world_from_body, by the truth.
        fix: by the map's patches; None where they did not tell.
    """

    drone: int
    revision: int
    true: Pose
    fix: Localized | None


class Chain:
    """The maps of a flight that begins at one of a recording's instants.

    Args:
        recording: each drone with its truth; where one has no frame, or no truth, it is left out.
        begins: index of the leader's frame that it begins with.
        seed: of the attitudes' and the predictions' errors.
        novelty_deg: how newly a map looks before it is extended.
    """

    def __init__(self, recording: Recording, begins: int, seed: int, novelty_deg: float) -> None:
        self._drones = recording.drones
        self._leader = [drone.name for drone in recording.drones].index(recording.leader)
        self._instants = [frame.at_ns for frame in recording.drone(recording.leader).frames]
        self._apart_ns = _AT_ONCE * 1e9 / recording.frame_rate_hz
        self._at = begins
        self._rng = np.random.default_rng([seed, begins])
        index = {drone.name: i for i, drone in enumerate(recording.drones)}
        pairs = [(index[pair.a], index[pair.b]) for pair in recording.known_distances]
        there = self._there()
        apart = tuple(
            (a + 1, b + 1, self._apart_m(a, b)) for a, b in pairs if a in there and b in there
        )
        mapping = MapOptions(**exactness(recording, are_distances_recorded=True))
        options = WorkOptions(
            apart, mapping, _PIPELINE, mapping.detectors, InterMavOptions(), tracked=True
        )
        self._workshop = Workshop(recording.drones[0].sensor, options)
        self._map: ReadyMap | None = None
        self._world_from_ned = Pose.identity()
        self._novelty_deg = novelty_deg
        self._n_extensions = 0
        self._most = [0] * len(recording.drones)
        self.ended = ""
        """Why there are no more maps."""

    def looks(self, step: int, n_extensions: int) -> Iterator[Look]:
        """Fly on, every so many frames of the leader's, until so many extensions are done with.

        The map is extended where most drones see too little of it or see it from afar, as a
        flight's is; the frames until then are looked for on it.
        """
        if not self._begun():
            return
        while self._at + step < len(self._instants):
            self._at += step
            looks = [self._look(i) for i in self._there()]
            yield from looks
            if not looks or 2 * sum(map(self._is_wanted, looks)) <= len(looks):
                continue
            if self._n_extensions == n_extensions or not self._extended(looks):
                return

    def alone(self, for_s: float) -> Iterator[Look]:
        """Have each drone go on by its own frames alone from where these maps end."""
        if self._map is None or self._current.templates is None or not for_s:
            return
        first_ns, last_ns = self._instants[0], self._instants[-1]
        latest_ns = max(last_ns - round(for_s * 1e9), first_ns + round(_BEFORE_S * 1e9))
        ends_ns = min(self._instants[self._at], latest_ns)
        for i in self._there():
            drone, templates = self._drones[i], self._current.templates
            on_map = self._shots(i, ends_ns - round(_BEFORE_S * 1e9), ends_ns)
            beyond = self._shots(i, ends_ns, ends_ns + round(for_s * 1e9))
            options = replace(_PIPELINE, drone_id=i + 1)
            found = found_alone(
                on_map, beyond, templates, drone.sensor, self._workshop, options, self._rng
            )
            for shot, fix in zip(beyond, found, strict=bool(found)):
                yield Look(i, self._n_extensions, shot.true, fix)

    def _shots(self, i: int, after_ns: int, until_ns: int) -> list[Shot]:
        """Return a drone's frames of some time of which there is a truth."""
        drone, out = self._drones[i], []
        for k, frame in enumerate(drone.frames):
            if drone.truth is None or not after_ns < frame.at_ns <= until_ns:
                continue
            true = drone.truth.pose_at(frame.at_ns)
            if true is not None:
                image = load_image(frame.path, drone.sensor.camera)
                out.append(Shot(Frame(image, frame.at_ns, k, 0), self._world_from_ned @ true))
        return out

    def _begun(self) -> bool:
        there = self._there()
        if self._leader not in there:
            self.ended = "there is no truth of the leader's"
            return False
        made = self._workshop.first_map([self._answer(i, None) for i in there], self._leader + 1)
        if isinstance(made, NoMap):
            self.ended = made.reason
            return False
        self._map = self._ready(self._workshop.encoded(made, b"").data)
        # The leader's body is where the world begins.
        first = self._map.index.landmark_map.keyframes[0].world_from_body
        self._world_from_ned = first @ self._truth(self._leader).inverse()
        return True

    def _extended(self, looks: list[Look]) -> bool:
        stored = self._current.stored()
        frames = [self._answer(look.drone, look.fix) for look in looks]
        made = self._workshop.next_revision(stored.revision, frames, at_once=False)
        if isinstance(made, NoMap):
            self.ended = made.reason
            return False
        self._map = self._ready(self._workshop.encoded(made, stored.revision).data)
        self._n_extensions += 1
        self._most = [0] * len(self._most)
        return True

    @property
    def _current(self) -> ReadyMap:
        if self._map is None:
            raise RuntimeError("there is no map yet")
        return self._map

    def _ready(self, data: bytes) -> ReadyMap:
        current = b"" if self._map is None else self._map.stored().revision
        return self._workshop.ready(MapOffer.of(BlobKind.MAP, data), current, {})

    def _look(self, i: int) -> Look:
        """Find a drone's frame from where a filter may put it."""
        drone, templates = self._drones[i], self._current.templates
        true = self._world_from_ned @ self._truth(i)
        if templates is None:
            raise RuntimeError("a map is not ready to be tracked")
        fix = track(
            self._image(i), drone.sensor.camera, drone.sensor.body_from_cam, templates,
            predicted(true, self._rng), None, _PIPELINE.tracking, _PIPELINE.localization, i + 1,
        )  # fmt: skip
        return Look(i, self._n_extensions, true, fix if isinstance(fix, Localized) else None)

    def _is_wanted(self, look: Look) -> bool:
        """Whether a drone wants the map extended: it sees too little, or anew what it sees.

        Of the reasons of ``swarm.own_vote`` coverage and vagueness do not count here.
        """
        fix, i = look.fix, look.drone
        if fix is None:
            return True
        self._most[i] = max(self._most[i], min(fix.n_seen, _UPDATES.enough))
        return (
            fix.n_seen < max(_UPDATES.tracked, _UPDATES.share * self._most[i])
            or fix.novelty_deg > self._novelty_deg
        )

    def _answer(self, i: int, fix: Localized | None) -> FrameAnswer:
        """Return what a drone gives of its frame for a map."""
        drone, image = self._drones[i], self._image(i)
        detail: Detail = "all"
        if self._map is not None:
            landmark_map = self._map.index.landmark_map
            sensor = drone.sensor
            detail = needed_detail(fix, landmark_map, sensor.camera, sensor.body_from_cam)
        noise = exp_so3(np.deg2rad(_ATTITUDE_DEG) * self._rng.standard_normal(3))
        answer = FrameAnswer(
            i + 1, 1, self._frame_ns(i), 0.0,
            quaternion_from_matrix(self._truth(i).rotation @ noise),
            drone.sensor.body_from_cam, drone.sensor.camera,
            self._workshop.encode_keyframe(image, _MOST_BYTES, detail),
        )  # fmt: skip
        if fix is None:
            return answer
        where = Prior(fix.world_from_body, fix.covariance())
        seen = self._workshop.seen(image, self._current.stored().revision, where)
        return replace(answer, world_from_body=fix.world_from_body, seen=seen)

    def _image(self, i: int) -> Image:
        drone = self._drones[i]
        return load_image(drone.frames[self._index(drone)].path, drone.sensor.camera)

    def _truth(self, i: int) -> Pose:
        truth = self._drones[i].truth
        pose = None if truth is None else truth.pose_at(self._frame_ns(i))
        if pose is None:
            raise ValueError(f"there is no truth of {self._drones[i].name}")
        return pose

    def _there(self) -> list[int]:
        """Return the drones that have a frame of this instant, and its truth."""
        return [
            i
            for i, drone in enumerate(self._drones)
            if abs(self._frame_ns(i) - self._instants[self._at]) <= self._apart_ns
            and drone.truth is not None
            and drone.truth.pose_at(self._frame_ns(i)) is not None
        ]

    def _frame_ns(self, i: int) -> int:
        return self._drones[i].frames[self._index(self._drones[i])].at_ns

    def _index(self, drone: Drone) -> int:
        """Return which of a drone's frames is the nearest to the leader's instant."""
        at_ns = np.array([frame.at_ns for frame in drone.frames])
        return int(np.argmin(np.abs(at_ns - self._instants[self._at])))

    def _apart_m(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self._truth(a).translation - self._truth(b).translation))
