"""The shared map (IV-C) as bytes, and the revision that names them.

Every accepted map has exactly one byte string: ``encode_map(decode_map(b)) ==
b``. Points and pixels lie on grids finer than what they were measured to
(``landmark_grid``); poses, cameras and images are kept exactly.
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.landmark_map import (
    MAX_JOINED,
    NAME_BYTES,
    NO_NAME,
    JoinedMap,
    Keyframe,
    KnownDistance,
    LandmarkMap,
)
from vcl_companion.vision.information import is_covariance
from vcl_companion.wire.header import (
    HEADER_BYTES,
    MAX_BLOB_BYTES,
    BlobKind,
    decode_header,
    encode_header,
)
from vcl_companion.wire.landmark_grid import Views, pixels_of_steps, steps_of_pixels
from vcl_companion.wire.landmark_kernels import Integers
from vcl_companion.wire.map_landmarks import decode_landmarks, encode_landmarks
from vcl_companion.wire.pose_codec import (
    MAX_COORDINATE_M,
    encode_camera,
    encode_image,
    encode_pose,
    take_camera,
    take_image,
    take_pose,
)
from vcl_companion.wire.reader import Reader

REVISION_BYTES = NAME_BYTES
MAX_KEYFRAMES = 256
MAX_LANDMARKS = 32_768
MAX_CELLS = 1 << 20  # landmarks times keyframes: bounds the observation table
MAX_DISTANCES = 256

# Head, after version and kind
# | 2  | u8      | detectors: 1 akaze + 2 sift + 4 orb; + 8: the first keyframe is not exact |
# | 3  | u8      | bytes of the parent revision: 0 or 8    |
# | 4  | u16     | keyframes V, at least 1                 |
# | 6  | u16     | known distances D                       |
# | 8  | u32     | landmarks N                             |
# | 12 | f64     | pixel noise, px                         |
# | 20 | 8 bytes | parent revision, zeros when there is none |
# | 28 | u8      | bytes of the world's name: 0 or 8; 8 only with a parent |
# | 29 | 8 bytes | the world's name, zeros when it has none |
# | 37 | u8      | joined maps J, at most 16; some only with a world |
_HEAD = struct.Struct("<BBHHId8sB8sB")
_DETECTORS = ("akaze", "sift", "orb")  # bit by bit
_ANCHORED = 1 << len(_DETECTORS)

# If it is not: 21 x f64, its covariance's upper triangle by rows, m and rad
_ANCHOR = struct.Struct("<21d")
_UPPER = np.triu_indices(6)

# D times | 0 | 2 x u16 | keyframes a, b | then | 4 | 2 x f64 | distance, sigma, m |
_DISTANCE = struct.Struct("<2H2d")

# J times | 0 | 2 x 8 bytes | revision, world | then world_from_other: a pose (see pose_codec),
# | 56 | f64 | its scale |
_SCALE = struct.Struct("<d")
_MAX_SCALE = 10.0  # nor smaller than one over this: no two maps in metres differ by more

# V times | 0 | u8 | drone | 1 | u64 | captured at, ns | then two poses (world_from_body,
# body_from_cam), camera, image: see pose_codec
_KEYFRAME = struct.Struct("<BQ")

# Then the landmarks, see ``map_landmarks``, to the end.


@dataclass(frozen=True, eq=False)
class MapHead:
    """What is in a map but its landmarks; the fields are those of ``LandmarkMap``."""

    keyframes: tuple[Keyframe, ...]
    n_landmarks: int
    pixel_noise_px: float
    detectors: tuple[str, ...]
    distances: tuple[KnownDistance, ...]
    parent: bytes
    anchor_covariance: Array
    world: bytes
    joined: tuple[JoinedMap, ...]

    @classmethod
    def of(cls, m: LandmarkMap) -> MapHead:
        """Return a map's."""
        n = len(m.points_world)
        return cls(
            m.keyframes,
            n,
            m.pixel_noise_px,
            m.detectors,
            m.distances,
            m.parent,
            m.anchor_covariance,
            m.world,
            m.joined,
        )

    def map_with(self, points: Array, pixels: Integers) -> LandmarkMap:
        """Return the map whose landmarks lie there.

        Args:
            points: (N, 3) world frame, m.
            pixels: (N, V, 2) steps, see ``steps_of_pixels``.

        Raises:
            ValueError: they are no landmarks, or out of range.
        """
        if np.abs(points).max(initial=0.0) > MAX_COORDINATE_M:
            raise ValueError("a landmark lies out of range")
        return LandmarkMap(
            keyframes=self.keyframes,
            points_world=points,
            observed_px=pixels_of_steps(pixels),
            pixel_noise_px=self.pixel_noise_px,
            detectors=self.detectors,
            distances=self.distances,
            parent=self.parent,
            anchor_covariance=self.anchor_covariance,
            world=self.world,
            joined=self.joined,
        )


def revision_of(data: bytes) -> bytes:
    """Return the 8 bytes that name a map: the first of the SHA-256 of its encoded bytes."""
    return hashlib.sha256(data).digest()[:REVISION_BYTES]


def parent_of(data: bytes) -> bytes:
    """Return the revision that an encoded map was made from; empty for a first map.

    Raises:
        WireError: the bytes do not begin like a map; what follows is not looked at.
    """
    kind = decode_header(data)
    if kind != BlobKind.MAP:
        raise WireError(f"not a map: blob kind {kind}")
    _, n_parent, _, _, _, _, parent, *_ = Reader(data, "map", HEADER_BYTES).unpack(_HEAD)
    return _checked_name(n_parent, parent)


def encode_map(landmark_map: LandmarkMap) -> bytes:
    """Return the bytes of a map; points and pixels are rounded to their grids.

    Raises:
        ValueError: the map breaks a bound that peers hold every map to.
    """
    m = landmark_map
    if len(m.points_world) and np.abs(m.points_world).max() > MAX_COORDINATE_M:
        raise ValueError(f"a landmark lies further than {MAX_COORDINATE_M:.0f} m from the origin")
    head = encode_header(BlobKind.MAP) + encode_head(MapHead.of(m))
    pixels = steps_of_pixels(m.observed_px)
    data = head + encode_landmarks(m.points_world, pixels, Views(m.keyframes))
    if len(data) > MAX_BLOB_BYTES:
        raise ValueError(f"a map of {len(data)} bytes, at most {MAX_BLOB_BYTES}")
    return data


def encode_head(m: MapHead) -> bytes:
    """Return what goes before the landmarks of a map, without version and kind.

    Raises:
        ValueError: see ``encode_map``.
    """
    n_landmarks, n_keyframes = m.n_landmarks, len(m.keyframes)
    _check_counts(n_landmarks, n_keyframes, len(m.distances))
    detectors = sum(1 << bit for bit, name in enumerate(_DETECTORS) if name in m.detectors)
    if not m.detectors or not set(m.detectors) <= set(_DETECTORS):
        raise ValueError(f"detectors must be some of {', '.join(_DETECTORS)}: {m.detectors}")
    _check_line(m.parent, m.world, len(m.joined))
    is_anchored = bool(m.anchor_covariance.any())
    parts = [
        _HEAD.pack(
            detectors | (_ANCHORED if is_anchored else 0),
            len(m.parent),
            n_keyframes,
            len(m.distances),
            n_landmarks,
            m.pixel_noise_px,
            m.parent,
            len(m.world),
            m.world,
            len(m.joined),
        ),
    ]
    if is_anchored:
        parts.append(_ANCHOR.pack(*m.anchor_covariance[_UPPER]))
    for distance in m.distances:
        _check_distance(distance)
        parts.append(
            _DISTANCE.pack(
                distance.keyframe_a, distance.keyframe_b, distance.distance_m, distance.sigma_m
            )
        )
    parts += [_encode_joined(joined) for joined in m.joined]
    n_bytes = sum(len(keyframe.image_bytes) for keyframe in m.keyframes)
    if n_bytes > MAX_BLOB_BYTES:
        raise ValueError(f"a map with {n_bytes} bytes of images, at most {MAX_BLOB_BYTES}")
    return b"".join(parts + [_encode_keyframe(keyframe) for keyframe in m.keyframes])


def decode_map(data: bytes) -> LandmarkMap:
    """Return the map of encoded bytes.

    Raises:
        WireError: the bytes are not a map, or one out of bounds.
    """
    if len(data) > MAX_BLOB_BYTES:
        raise WireError(f"a map of {len(data)} bytes, at most {MAX_BLOB_BYTES}")
    kind = decode_header(data)
    if kind != BlobKind.MAP:
        raise WireError(f"not a map: blob kind {kind}")
    reader = Reader(data, "map", HEADER_BYTES)
    try:
        head = take_head(reader)
        views = Views(head.keyframes)
        return head.map_with(*decode_landmarks(reader.rest(), head.n_landmarks, views))
    except ValueError as error:
        raise WireError(f"map: {error}") from None


def take_head(reader: Reader) -> MapHead:
    """Return what comes before the landmarks of a map.

    Raises:
        WireError: the bytes are none.
        ValueError: or are out of bounds.
    """
    (
        detectors, n_parent, n_keyframes, n_distances, n_landmarks, noise_px, parent,
        n_world, world, n_joined,
    ) = reader.unpack(_HEAD)  # fmt: skip
    is_anchored = bool(detectors & _ANCHORED)
    if not (detectors & (_ANCHORED - 1) and detectors < 2 * _ANCHORED):
        raise WireError(f"map: unknown detectors {detectors:#x}")
    parent, world = _checked_name(n_parent, parent), _checked_name(n_world, world)
    _check_line(parent, world, n_joined)
    _check_counts(n_landmarks, n_keyframes, n_distances)
    anchor = _take_anchor(reader) if is_anchored else np.zeros((6, 6))
    distances = tuple(KnownDistance(*reader.unpack(_DISTANCE)) for _ in range(n_distances))
    for distance in distances:
        _check_distance(distance)
    joined = tuple(_take_joined(reader) for _ in range(n_joined))
    return MapHead(
        tuple(_take_keyframe(reader) for _ in range(n_keyframes)),
        n_landmarks,
        noise_px,
        tuple(n for bit, n in enumerate(_DETECTORS) if detectors >> bit & 1),
        distances,
        parent,
        anchor,
        world,
        joined,
    )


def _take_anchor(reader: Reader) -> Array:
    """Return the covariance of a first keyframe that is not exact.

    Raises:
        WireError: it is none.
    """
    numbers = reader.unpack(_ANCHOR)
    covariance = np.zeros((6, 6))
    covariance[_UPPER] = covariance.T[_UPPER] = numbers
    if not (any(numbers) and is_covariance(covariance)):
        raise WireError("map: not a covariance of its first keyframe")
    return covariance


def _checked_name(n_bytes: int, padded: bytes) -> bytes:
    """Return the parent revision, or the world's name, of its two fields."""
    name = padded[:n_bytes]
    if n_bytes not in (0, NAME_BYTES) or padded[n_bytes:].strip(b"\0") or name == NO_NAME:
        raise WireError("map: malformed parent revision or world")
    return name


def _encode_joined(joined: JoinedMap) -> bytes:
    """Return the bytes of a map that was merged into this one."""
    at = joined.world_from_other
    _check_scale(at.scale)
    pose = encode_pose(Pose(at.rotation, at.translation))
    return joined.revision + joined.world + pose + _SCALE.pack(at.scale)


def _take_joined(reader: Reader) -> JoinedMap:
    """Return the merged map that comes next.

    Raises:
        WireError: it is none.
        ValueError: or its scale is out of bounds.
    """
    revision, world = reader.take(NAME_BYTES), reader.take(NAME_BYTES)
    pose = take_pose(reader)
    (scale,) = reader.unpack(_SCALE)
    _check_scale(scale)
    return JoinedMap(revision, world, Similarity(pose.rotation, pose.translation, scale))


def _encode_keyframe(keyframe: Keyframe) -> bytes:
    """Return the bytes of one keyframe without its observations."""
    if not 1 <= keyframe.drone_id <= 255 or not 0 <= keyframe.captured_at_ns < 1 << 63:
        raise ValueError(
            f"a keyframe of drone {keyframe.drone_id} captured at {keyframe.captured_at_ns} ns"
        )
    return (
        _KEYFRAME.pack(keyframe.drone_id, keyframe.captured_at_ns)
        + encode_pose(keyframe.world_from_body)
        + encode_pose(keyframe.body_from_cam)
        + encode_camera(keyframe.camera)
        + encode_image(keyframe.image_bytes)
    )


def _take_keyframe(reader: Reader) -> Keyframe:
    """Return the keyframe that comes next."""
    drone_id, captured_at_ns = reader.unpack(_KEYFRAME)
    if drone_id == 0 or captured_at_ns >= 1 << 63:
        raise WireError(f"map: keyframe of drone {drone_id} at {captured_at_ns} ns")
    return Keyframe(
        drone_id,
        captured_at_ns,
        take_pose(reader),
        take_pose(reader),
        take_camera(reader),
        take_image(reader),
    )


def _check_counts(n_landmarks: int, n_keyframes: int, n_distances: int) -> None:
    """Raise ValueError for counts out of bounds, before any work is done for them."""
    if not 1 <= n_keyframes <= MAX_KEYFRAMES:
        raise ValueError(f"{n_keyframes} keyframes, allowed 1 to {MAX_KEYFRAMES}")
    if n_landmarks > MAX_LANDMARKS or n_landmarks * n_keyframes > MAX_CELLS:
        raise ValueError(f"{n_landmarks} landmarks in {n_keyframes} keyframes are too many")
    if n_distances > MAX_DISTANCES:
        raise ValueError(f"{n_distances} known distances, at most {MAX_DISTANCES}")


def _check_line(parent: bytes, world: bytes, n_joined: int) -> None:
    """Raise ValueError for what cannot be said of where a map comes from."""
    if len(parent) not in (0, REVISION_BYTES):
        raise ValueError(f"a parent revision has 0 or {REVISION_BYTES} bytes: {parent!r}")
    if world and not parent:
        raise ValueError("a first map is its own world")
    if n_joined > MAX_JOINED or (n_joined and not world):
        raise ValueError(f"{n_joined} joined maps, at most {MAX_JOINED}, and none of a first map")


def _check_scale(scale: float) -> None:
    """Raise ValueError for a scale between two maps in metres that there cannot be."""
    if not 1.0 / _MAX_SCALE <= scale <= _MAX_SCALE:
        raise ValueError(f"a joined map at a scale of {scale}")


def _check_distance(distance: KnownDistance) -> None:
    """Raise ValueError for a distance that cannot give a scale."""
    numbers = (distance.distance_m, distance.sigma_m)
    if not (
        all(map(math.isfinite, numbers))
        and 0 < distance.distance_m <= 2 * MAX_COORDINATE_M
        and distance.sigma_m > 0
        and distance.keyframe_a != distance.keyframe_b
    ):
        raise ValueError(f"not a known distance: {distance}")
