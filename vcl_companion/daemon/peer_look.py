"""The vision of a host (IV-E): where the drone is that took a frame, from one of our own."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.rotation import matrix_from_quaternion
from vcl_companion.localization.filter_state import FilterState, north_aligned
from vcl_companion.localization.inter import NoProposal, Proposal, localize_inter
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.localization.pair_evidence import Observer
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.vision.features import Detector, FeatureOptions, Features, Image, detect
from vcl_companion.wire.frame_codec import FrameAnswer

# Several targets ask about the same moment: our own features of it are found once.
_N_KEPT = 6


class PeerLook:
    """Looks at what peers saw; for one thread.

    Args:
        sensor: of our camera.
        features: how they are found.
        options: thresholds.
        indexed_by: detectors that maps come indexed by, some only later.
        tries_all: whether every index that there is is tried; else only that by
            ``options.detector``: the paper's way.
    """

    def __init__(
        self,
        sensor: Sensor,
        features: FeatureOptions,
        options: InterMavOptions,
        indexed_by: tuple[Detector, ...],
        tries_all: bool,
    ) -> None:
        self._sensor = sensor
        self._features = features
        self._options = options
        self._is_made = options.detector in indexed_by
        self._tries_all = tries_all
        self._index: tuple[bytes, MapIndex] | None = None
        self._own: deque[tuple[int, Detector, Features]] = deque(maxlen=_N_KEPT)

    def from_frame(
        self, frame: Frame, state: FilterState, stored: StoredMap, seen: FrameAnswer
    ) -> Proposal | NoProposal:
        """Propose where the drone that saw a frame was.

        Args:
            frame: our own.
            state: what we believe of its instant.
            stored: the map of both.
            seen: the target's frame.

        Raises:
            ValueError: the target's image cannot be decoded, or the map holds
                nothing that our detector finds.
        """
        image = decode_image(seen.image_bytes, seen.camera)
        said: Proposal | NoProposal = NoProposal("the map is not indexed for peers yet")
        for index in self._indexes(stored):
            said = self._by_index(frame, state, index, seen, image)
            if isinstance(said, Proposal):
                break
        return said

    def _by_index(
        self,
        frame: Frame,
        state: FilterState,
        index: MapIndex,
        seen: FrameAnswer,
        image: Image,
    ) -> Proposal | NoProposal:
        """Propose it by one detector."""
        attitude = state.ned_from_body
        if attitude is not None:
            attitude = north_aligned(state) @ attitude
        host = Observer(
            self._own_features(frame, index.detector),
            self._sensor.camera,
            self._sensor.body_from_cam,
            attitude,
        )
        attitude = seen.ned_from_body
        target = Observer(
            detect(image, index.detector, self._features),
            seen.camera,
            seen.body_from_cam,
            None if attitude is None else matrix_from_quaternion(attitude),
            seen.has_heading,
        )
        pose, covariance = state.world_from_body, state.pose_covariance()
        return localize_inter(host, pose, covariance, target, index, self._options)

    def _own_features(self, frame: Frame, detector: Detector) -> Features:
        for sequence, by, features in self._own:
            if (sequence, by) == (frame.sequence, detector):
                return features
        found = detect(np.asarray(frame.image), detector, self._features)
        self._own.append((frame.sequence, detector, found))
        return found

    def _indexes(self, stored: StoredMap) -> Iterator[MapIndex]:
        """Yield the indexes to try, the cheapest first."""
        known: MapIndex | None = stored.index
        while known is not None:
            if self._tries_all or known.detector == self._options.detector:
                yield known
            known = known.fallback
        if not self._is_made:
            yield self._own_index(stored)

    def _own_index(self, stored: StoredMap) -> MapIndex:
        """Return the index by a detector that nobody else in this daemon uses."""
        if self._index is None or self._index[0] != stored.revision:
            index = index_map(stored.index.landmark_map, self._options.detector, self._features)
            self._index = (stored.revision, index)
        return self._index[1]
