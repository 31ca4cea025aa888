"""A map that came or was made, and what has to be done with it before it can be flown on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.shared_arrays import shared
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.mapping.agreement import broken_descent, contradiction, moved_to, too_little_of
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.options import MOST_KEYFRAMES, MOST_PIXELS
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.vision.features import Detector, FeatureOptions, Features
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.map_codec import decode_map, parent_of, revision_of
from vcl_companion.wire.map_part import decode_map_part
from vcl_companion.wire.map_update import (
    decode_map_update,
    encode_map_update,
    images_by_name,
    images_in_map,
    images_in_update,
    images_missing_in,
    names_of_update,
    needs_parent,
    with_images,
)


@dataclass(frozen=True)
class MapOffer:
    """An encoded map of which only the names have been read.

    Attributes:
        kind: whole, or for one who has its parent, or some of its images.
        blob: its bytes.
        revision: what it calls itself; proven when it is read.
        parent: what it was made from; empty for a first map.
        update: the same for one who has its parent, if that is encoded already.
        part_of: of a part, the revision of the whole map; empty for a whole one.
        needs_parent: whether it can be read by one who has its parent only.
    """

    kind: BlobKind
    blob: bytes
    revision: bytes
    parent: bytes
    update: bytes = b""
    part_of: bytes = b""
    needs_parent: bool = False

    @classmethod
    def of(cls, kind: BlobKind, blob: bytes) -> MapOffer:
        """Read the names.

        Raises:
            WireError: the bytes do not begin like a map of this kind.
        """
        if kind == BlobKind.MAP_UPDATE:
            return cls(kind, blob, *names_of_update(blob), needs_parent=needs_parent(blob))
        if kind == BlobKind.MAP_PART:
            whole, data = decode_map_part(blob)
            return cls(kind, blob, revision_of(data), parent_of(data), part_of=whole)
        return cls(kind, blob, revision_of(blob), parent_of(blob))

    def images_here(
        self, heard: Mapping[bytes, bytes], current: StoredMap | None
    ) -> dict[bytes, bytes]:
        """Return what is here of the images that it takes us to hold, by their names.

        Args:
            heard: images that were sent ahead.
            current: the map in use.

        Raises:
            WireError: the bytes are no map.
        """
        missing = self.images_missing()
        if not missing:
            return {}
        keyframes = () if current is None else current.index.landmark_map.keyframes
        here = dict(heard) | images_by_name(keyframes)
        return {name: here[name] for name in missing if name in here}

    def images_missing(self) -> frozenset[bytes]:
        """Return the names of the images that it takes us to hold.

        Raises:
            WireError: the bytes are no map.
        """
        is_update = self.kind == BlobKind.MAP_UPDATE
        return images_missing_in(self.blob) if is_update else frozenset()

    def images(self) -> frozenset[bytes]:
        """Return the names of all images, of a whole map or an update that needs no parent.

        Raises:
            WireError: the bytes are no map.
        """
        if self.kind == BlobKind.MAP_UPDATE:
            return images_in_update(self.blob) | self.images_missing()
        return images_in_map(self.blob)

    def whole(self, parent: LandmarkMap | None, held: Mapping[bytes, bytes]) -> bytes:
        """Return the whole map's bytes.

        Args:
            parent: the map that an update that needs its parent is of.
            held: images that were sent ahead or are of the map in use, by their names.

        Raises:
            WireError: the bytes are no map, or not one of this parent, or need an image that
                is not held.
        """
        if self.kind == BlobKind.MAP:
            return self.blob
        if self.kind == BlobKind.MAP_PART:
            return decode_map_part(self.blob)[1]
        return decode_map_update(self.blob, parent, held)


@dataclass(frozen=True, eq=False)
class HandOut:
    """A map to be handed out; the fields are those of ``StoredMap``."""

    revision: bytes
    parent: bytes
    data: bytes
    update: bytes


@dataclass(frozen=True, eq=False)
class ReadyMap:
    """A map that can be flown on; the other fields are those of ``StoredMap``.

    Attributes:
        contradicts: how it contradicts the map in use; empty when it does not.
        unproven: of another world that says where ours lies in it, how little of ours it has to
            show that by; empty where that suffices.
        part_of: see ``StoredMap``.
    """

    data: bytes
    index: MapIndex
    update: bytes
    templates: Templates | None
    contradicts: str = ""
    part_of: bytes = b""
    unproven: str = ""

    def stored(self) -> StoredMap:
        """Return it as it is held while it is in use."""
        return StoredMap(
            revision_of(self.data),
            self.data,
            self.index,
            self.update,
            self.templates,
            self.part_of,
        )


def ready_map(
    offer: MapOffer,
    current: StoredMap | None,
    detector: Detector,
    features: FeatureOptions,
    memory: FeatureMemory,
    tracked: bool,
    held: Mapping[bytes, bytes],
    decode: Callable[[bytes], LandmarkMap] = decode_map,
    calibration_px: float = 0.0,
) -> ReadyMap:
    """Decode, index and cut patches; takes a second, beside the event loop and the frames.

    Its large arrays lie in memory that another process can have too.

    Args:
        offer: what came or was made.
        current: the map in use, perhaps its parent.
        detector: the localization's own.
        features: how they are found.
        memory: finds them, and decodes images.
        tracked: whether the map is also made ready to be tracked.
        held: images that it may take us to hold, by their names.
        decode: ``decode_map``, or what remembers what that has returned.
        calibration_px: what lenses may be off; see ``map_uncertainty``.

    Raises:
        WireError: the bytes are no map, or need a parent that is not in use here, or
            an image that is not.
        ValueError: an image cannot be used, or the map is not determined.
    """
    parent = None
    if offer.needs_parent:
        # To a part comes what any revision of its line has beyond it.
        if current is None or not (current.revision == offer.parent or current.part_of):
            raise ValueError("an update of a map that is not in use here")
        parent = current.index.landmark_map
    data = offer.whole(parent, held)
    whole = decode(data)
    if len(whole.keyframes) > MOST_KEYFRAMES:
        # What is known of each of them is in every state, which frames wait for.
        raise ValueError(f"a map of {len(whole.keyframes)} keyframes, at most {MOST_KEYFRAMES}")
    if whole.n_pixels > MOST_PIXELS:
        raise ValueError(f"a map of {whole.n_pixels} pixels, at most {MOST_PIXELS}")

    update = offer.update
    if current is not None and current.revision == offer.parent and not update:
        if offer.needs_parent:
            update = with_images(offer.blob, held)
        else:
            update = encode_map_update(data, current.index.landmark_map, whole)

    sure = map_uncertainty(whole, calibration_px)
    index = shared(_indexed(whole, detector, features, memory, sure))
    templates = None
    if tracked:
        templates = shared(prepare_templates(index.landmark_map, index.uncertainty, memory.pyramid))
    contradicts = unproven = ""
    if current is not None:
        contradicts = _contradiction(current, index.landmark_map, offer.revision)
        unproven = _unproven(current, index.landmark_map, offer.revision)
    return ReadyMap(data, index, update, templates, contradicts, offer.part_of, unproven)


def _contradiction(current: StoredMap, landmark_map: LandmarkMap, revision: bytes) -> str:
    """Say how a map contradicts the one in use; empty if it does not.

    One of another world that ours was joined with is compared in ours. Where it was not, and
    they have keyframes in common all the same, they are of one world by different names.
    """
    own = current.index.landmark_map
    if landmark_map.world_of(revision) != current.world:
        joined = landmark_map.joined_with(current.world)
        if joined is not None:
            landmark_map = moved_to(landmark_map, joined.world_from_other.inverse())
    is_child = landmark_map.parent == current.revision
    broken = broken_descent(own, landmark_map) if is_child else ""
    return broken or contradiction(own, current.index.uncertainty, landmark_map)


def _unproven(current: StoredMap, landmark_map: LandmarkMap, revision: bytes) -> str:
    """Say how little a map of another world has of ours, which it says was joined with it.

    Without that a comparison finds nothing, and whoever made it could have us go on anywhere, at
    any scale. Extended again and again, one that ours was merged into may have lost it honestly.
    """
    if landmark_map.world_of(revision) == current.world:
        return ""
    lacking = too_little_of(current.index.landmark_map, landmark_map)
    return f"of ours, which it says was joined with it, {lacking}" if lacking else ""


def with_fallbacks(
    index: MapIndex,
    detectors: tuple[Detector, ...],
    features: FeatureOptions,
    memory: FeatureMemory,
) -> MapIndex:
    """Return a map's index that falls back on other detectors, in this order.

    One that finds nothing of the map is left out.
    """
    fallback: MapIndex | None = None
    for detector in reversed(detectors):
        try:
            found = _indexed(index.landmark_map, detector, features, memory, index.uncertainty)
        except ValueError:
            continue
        fallback = replace(found, fallback=fallback)
    return replace(index, fallback=shared(fallback))


def _indexed(
    landmark_map: LandmarkMap,
    detector: Detector,
    features: FeatureOptions,
    memory: FeatureMemory,
    uncertainty: MapUncertainty,
) -> MapIndex:
    def features_of(keyframe: Keyframe) -> Features:
        return memory.features(keyframe.image_bytes, keyframe.camera, detector)

    return index_map(landmark_map, detector, features, features_of, uncertainty)
