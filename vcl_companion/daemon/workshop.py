"""What takes long: maps built, made ready to be flown on, searched for frames and for peers.

It keeps what it has made and found, so that a map is named rather than handed over
once more. One thread makes maps, one encodes our frames, one looks for them, one for peers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_building import Distances, build_map, merge_maps, update_map
from vcl_companion.daemon.map_offer import HandOut, MapOffer, ReadyMap, ready_map, with_fallbacks
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.peer_look import PeerLook
from vcl_companion.daemon.usage import give_back_freed
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.detail import Detail
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.inter import NoProposal, Proposal
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.pipeline import Effort, PipelineOptions, localize
from vcl_companion.localization.seen_by_patches import seen_by_patches
from vcl_companion.mapping.continuity import newest_part
from vcl_companion.mapping.given_depths import SceneDepth
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.local_map import LocalMap, OwnView, local_map
from vcl_companion.mapping.new_landmarks import Shown, shown
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.vision.features import Detector, FeatureOptions, Image, detect
from vcl_companion.vision.focus import focused
from vcl_companion.vision.patch_tables import pyramid_of
from vcl_companion.vision.signature import signature_of
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.map_part import decode_map_part, encode_map_part
from vcl_companion.wire.map_update import encode_map_update

# The one in use, and the next one.
_N_MAPS = 2
# Beside a map's keyframes, the frames of a round: one of each contributor, several of who is lost.
_N_NEW_IMAGES = 16
# Landmarks that are looked for in a frame, to tell where it shows them: half are found.
_MOST_SEEN = 1000
# Less of a map would not tell where one is.
_LEAST_KEYFRAMES, _LEAST_LANDMARKS = 2, 100
# Of our own frames, which are a moment apart: quickly found, and enough in each part of the image.
_OWN_FEATURES = FeatureOptions(max_features=600)


@dataclass(frozen=True, eq=False)
class OwnImage:
    """One of our own frames as a local map is made of it.

    Attributes:
        captured_at_ns: when, our clock.
        image: (H, W) uint8.
        world_from_body: where.
    """

    captured_at_ns: int
    image: Image
    world_from_body: Pose


class NotHereError(Exception):
    """A map that is named has to be handed over first."""


@dataclass(frozen=True)
class WorkOptions:
    """How the work is done.

    Attributes:
        known_distances: (drone, drone, metres).
        map: thresholds of the building.
        pipeline: of looking for a frame; how features are found.
        detectors: the localization's own, and what it falls back on.
        inter: of looking for peers.
        tracked: whether maps are made ready to be tracked by their patches; then every
            index that there is is tried for a peer as well.
    """

    known_distances: Distances
    map: MapOptions
    pipeline: PipelineOptions
    detectors: tuple[Detector, ...]
    inter: InterMavOptions
    tracked: bool


class Workshop:
    """Does the work; see the module.

    Args:
        sensor: of our camera.
        options: how.
    """

    def __init__(self, sensor: Sensor, options: WorkOptions) -> None:
        self._sensor = sensor
        self._options = options
        features = options.pipeline.features
        n_images = options.map.max_keyframes + _N_NEW_IMAGES
        self._memory = FeatureMemory(features, n_images)
        self._other_memory = FeatureMemory(features, n_images)  # another thread's
        self._look = PeerLook(sensor, features, options.inter, options.detectors, options.tracked)
        self._maps: dict[bytes, StoredMap] = {}
        self._encoded: tuple[bytes, LandmarkMap] | None = None
        self._own_features: dict[int, Shown] = {}

    def learn(self, stored: StoredMap) -> None:
        """Take a map that was made elsewhere, or before this workshop was."""
        self._maps.pop(stored.revision, None)
        self._maps[stored.revision] = stored
        while len(self._maps) > _N_MAPS:
            del self._maps[next(iter(self._maps))]

    def keep_only(self, revision: bytes) -> None:
        """Let go of all maps but one: the one in use, or that the next is made of.

        One that is named all the same is handed over once more, which costs little: its large
        arrays are shared.
        """
        for other in [name for name in list(self._maps) if name != revision]:
            self._maps.pop(other, None)

    def encode(self, image: Image, quality: int, most_bytes: int) -> bytes:
        """Return one of our frames as a host gets it, to say where it was; see ``encode_image``."""
        return encode_image(image, quality, most_bytes, self._options.map.image_format)

    def encode_keyframe(self, image: Image, most_bytes: int, detail: Detail) -> bytes:
        """Return one of our frames as all get it, for a map; see ``encode_image``.

        Args:
            image: (H, W) uint8.
            most_bytes: at most, if that can be.
            detail: how much of it is needed.
        """
        options = self._options.map
        if detail == "all" or not options.patches:
            return self.encode(image, options.keyframe_quality, most_bytes)
        strongest = FeatureOptions(max_features=options.update_features)
        corners = detect(image, self._options.detectors[0], strongest).pixels
        quality = options.update_quality if detail == "coarse" else options.keyframe_quality
        return self.encode(focused(image, corners), quality, most_bytes)

    def seen(self, image: Image, revision: bytes, where: Prior) -> SeenLandmarks | None:
        """Return where one of our frames shows landmarks of a map; see ``seen_by_patches``.

        Args:
            image: (H, W) uint8.
            revision: of the map.
            where: the frame was taken, to a pixel.
        """
        templates = self._named(revision).templates
        if templates is None:
            return None
        return seen_by_patches(
            image, self._sensor.camera, self._sensor.body_from_cam, templates, revision,
            where, self._options.pipeline.tracking, _MOST_SEEN,
        )  # fmt: skip

    def signature(self, image: Image) -> bytes:
        """Return what tells peers the place that an image shows; see ``signature_of``."""
        return signature_of(image)

    def local_map(
        self, views: list[OwnImage], covariance: Array, drone_id: int, scene: SceneDepth
    ) -> LocalMap | NoMap:
        """Make a map of our own last frames; see ``local_map``.

        Args:
            views: V of them, the newest first.
            covariance: (6V, 6V) of their bodies' poses together.
            drone_id: ours.
            scene: how far what the newest one shows may be.
        """
        camera, known = self._sensor.camera, self._own_features
        own = [
            OwnView(
                view.captured_at_ns,
                pyramid_of(view.image),
                known.get(view.captured_at_ns)
                or shown(detect(view.image, "orb", _OWN_FEATURES), camera),
                view.world_from_body,
            )
            for view in views
        ]
        # One map and the next are mostly of the same frames.
        self._own_features = {view.captured_at_ns: view.features for view in own}
        return local_map(own, covariance, camera, self._sensor.body_from_cam, drone_id, scene)

    def look_at(self, frame: FrameAnswer) -> None:
        """Decode a frame that a map will be made of, and find its features, before it is.

        Raises:
            ValueError: its image cannot be used.
        """
        detector = self._options.detectors[0]
        self._memory.pyramid(frame.image_bytes, frame.camera)
        self._memory.features(frame.image_bytes, frame.camera, detector)

    def first_map(self, frames: list[FrameAnswer], leader: int) -> LandmarkMap | NoMap:
        """Build the first map of a round's frames; see ``build_map``."""
        options = self._options
        return build_map(frames, leader, options.known_distances, options.map, self._memory)

    def next_revision(
        self, revision: bytes, frames: list[FrameAnswer], at_once: bool
    ) -> LandmarkMap | NoMap:
        """Build the next revision of a map; see ``update_map``."""
        stored = self._alone(revision)
        return update_map(stored, frames, self._options.map, self._memory, at_once=at_once)

    def merged(
        self, revision: bytes, offer: MapOffer, held: Mapping[bytes, bytes]
    ) -> LandmarkMap | NoMap:
        """Build the next revision of a map of it and another one; see ``merge_maps``.

        Args:
            revision: of the map.
            offer: the other one; needs no parent.
            held: images that it may take us to hold, by their names.

        Raises:
            WireError: the bytes are no map, or need an image that is not held.
        """
        stored = self._alone(revision)
        built = merge_maps(stored, offer.whole(None, held), self._options.map, self._memory)
        give_back_freed()
        return built

    def encoded(self, built: LandmarkMap, parent: bytes) -> HandOut:
        """Return a map as peers get it, whole and for those who have its parent (empty: none).

        Raises:
            ValueError: the map breaks a bound that peers hold every map to.
        """
        before = self._named(parent).index.landmark_map if parent else None
        data = encode_map(built)
        self._encoded = data, decode_map(data)  # it will be flown on next
        update = encode_map_update(data, before, self._encoded[1])
        return HandOut(revision_of(data), built.parent, data, update)

    def part(self, revision: bytes, most_bytes: int) -> bytes:
        """Return the longest encoded part of a map (``map_part``) within bounds; empty for none.

        Args:
            revision: the map's.
            most_bytes: how long a part may be.
        """
        index = self._named(revision).index
        whole = index.landmark_map
        for n_keyframes in range(len(whole.keyframes) - 1, _LEAST_KEYFRAMES - 1, -1):
            images = whole.keyframes[-n_keyframes:]
            if sum(len(keyframe.image_bytes) for keyframe in images) > most_bytes:
                continue
            try:
                part = newest_part(whole, index.uncertainty, n_keyframes)
            except ValueError:
                continue  # these do not hang together
            blob = encode_map_part(revision, encode_map(part))
            if len(blob) <= most_bytes and len(part.points_world) >= _LEAST_LANDMARKS:
                return blob
        return b""

    def rest(self, revision: bytes, part: bytes) -> bytes:
        """Return what a map has beyond an encoded part of it or of an earlier revision."""
        of = decode_map(decode_map_part(part)[1])
        return encode_map_update(self._named(revision).data, of)

    def standalone(self, revision: bytes) -> bytes:
        """Return a map as an update that needs no parent: images can be left out of it."""
        stored = self._named(revision)
        return encode_map_update(stored.data, None, stored.index.landmark_map)

    def ready(self, offer: MapOffer, current: bytes, held: Mapping[bytes, bytes]) -> ReadyMap:
        """Make a map ready to be flown on, and keep it; see ``ready_map``.

        Args:
            offer: what came or was made.
            current: the map in use; empty for none.
            held: images that were sent ahead, by their names.

        Raises:
            WireError: the bytes are no map.
            ValueError: it cannot be used.
        """
        options = self._options
        stored = self._named(current) if current else None
        self.keep_only(current)
        ready = ready_map(
            offer, stored, options.detectors[0], options.pipeline.features, self._memory,
            options.tracked, held, self._decoded, options.map.calibration_px,
        )  # fmt: skip
        self.learn(ready.stored())
        give_back_freed()  # making it took a hundred megabytes more than it is
        return ready

    def _decoded(self, data: bytes) -> LandmarkMap:
        """Return the map of encoded bytes; that of the one encoded last is there, once."""
        encoded, self._encoded = self._encoded, None
        return encoded[1] if encoded is not None and encoded[0] == data else decode_map(data)

    def look_further(self, revision: bytes, number: int) -> None:
        """Find a keyframe's features by the other detectors, before ``more_indexed`` asks for all.

        Args:
            revision: of the map.
            number: of the keyframe in it.
        """
        keyframe = self._named(revision).index.landmark_map.keyframes[number]
        self._other_memory.of_keyframe(keyframe, self._options.detectors[1:])

    def more_indexed(self, revision: bytes) -> MapIndex:
        """Return a map's index with those by the other detectors to fall back on."""
        stored = self._alone(revision)
        options = self._options
        index = with_fallbacks(
            stored.index, options.detectors[1:], options.pipeline.features, self._other_memory
        )
        # Where the next map is asked about at all, it is mostly of the same images.
        keyframes = index.landmark_map.keyframes
        self._other_memory.keep_only({keyframe.image_bytes for keyframe in keyframes})
        if revision in self._maps:
            self._maps[revision] = replace(stored, index=index)
        give_back_freed()
        return index

    def find(
        self,
        image: Image,
        revision: bytes,
        prior: Prior | None,
        ned_from_body: Array | None,
        effort: Effort,
    ) -> Localized | NotLocalized:
        """Look for one of our frames by its features; see ``localize``."""
        stored = self._named(revision)
        return localize(
            image,
            self._sensor.camera,
            self._sensor.body_from_cam,
            stored.index,
            stored.templates,
            prior,
            ned_from_body,
            self._options.pipeline,
            effort,
        )

    def place_of_peer(
        self, frame: Frame, state: FilterState, revision: bytes, seen: FrameAnswer
    ) -> Proposal | NoProposal:
        """Propose where the drone was that saw a frame; see ``PeerLook``."""
        return self._look.from_frame(frame, state, self._named(revision), seen)

    def _alone(self, revision: bytes) -> StoredMap:
        """Return a map, and let go of the others."""
        stored = self._named(revision)
        self.keep_only(revision)
        return stored

    def _named(self, revision: bytes) -> StoredMap:
        try:
            return self._maps[revision]
        except KeyError:
            raise NotHereError from None
