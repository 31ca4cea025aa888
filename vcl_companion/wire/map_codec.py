"""The shared map (IV-C) as bytes, and the revision that names them.

Every accepted map has exactly one byte string: ``encode_map(decode_map(b)) ==
b``. Points lie on a grid of 2^-12 m and pixels on one of 2^-5 px (both finer
than what they were measured to); poses, cameras and images are kept exactly.
A pixel is told as what it is off from where its keyframe would see the point: a
tenth of a pixel takes a third of the bits of a place in the image.
"""

from __future__ import annotations

import hashlib
import math
import struct
from dataclasses import dataclass

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.vision.information import is_covariance
from vcl_companion.wire.columns import (
    Integers,
    encode_bits,
    encode_column,
    encode_residuals,
    take_bits,
    take_column,
    take_residuals,
)
from vcl_companion.wire.header import (
    HEADER_BYTES,
    MAX_BLOB_BYTES,
    BlobKind,
    decode_header,
    encode_header,
)
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

REVISION_BYTES = 8
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
_HEAD = struct.Struct("<BBHHId8s")
_DETECTORS = ("akaze", "sift", "orb")  # bit by bit
_ANCHORED = 1 << len(_DETECTORS)

# If it is not: 21 x f64, its covariance's upper triangle by rows, m and rad
_ANCHOR = struct.Struct("<21d")
_UPPER = np.triu_indices(6)

# D times | 0 | 2 x u16 | keyframes a, b | then | 4 | 2 x f64 | distance, sigma, m |
_DISTANCE = struct.Struct("<2H2d")

# V times | 0 | u8 | drone | 1 | u64 | captured at, ns | then two poses (world_from_body,
# body_from_cam), camera, image: see pose_codec
_KEYFRAME = struct.Struct("<BQ")

# Then three columns x, y, z of N values in steps of 2^-12 m, then for every keyframe N bits
# (seen there) and, of its seen landmarks, residuals u and residuals v in steps of 2^-5 px: the
# pixel from -1 on less the point's projection (none: the middle of the image), both rounded.
_STEPS_PER_M = 1 << 12
_STEPS_PER_PX = 1 << 5
_MARGIN_PX = 1.0  # a subpixel peak may lie a little outside of the image


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
        )

    def map_with(self, points: Integers, pixels: Integers) -> LandmarkMap:
        """Return the map whose landmarks lie there.

        Args:
            points: (N, 3) steps of 2^-12 m.
            pixels: (N, V, 2) steps of 2^-5 px, see ``steps_of_pixels``.

        Raises:
            ValueError: they are no landmarks, or out of range.
        """
        if np.abs(points).max(initial=0) > MAX_COORDINATE_M * _STEPS_PER_M:
            raise ValueError("a landmark lies out of range")
        return LandmarkMap(
            keyframes=self.keyframes,
            points_world=points / _STEPS_PER_M,
            observed_px=np.where(pixels < 0, np.nan, pixels / _STEPS_PER_PX - _MARGIN_PX),
            pixel_noise_px=self.pixel_noise_px,
            detectors=self.detectors,
            distances=self.distances,
            parent=self.parent,
            anchor_covariance=self.anchor_covariance,
        )


def steps_of_points(points_world: Array) -> Integers:
    """Return (N, 3) points in steps of 2^-12 m."""
    return np.rint(points_world * _STEPS_PER_M).astype(np.int64)


def steps_of_pixels(observed_px: Array) -> Integers:
    """Return (..., 2) pixels in steps of 2^-5 px from pixel -1 on; -1 where there is none.

    Raises:
        ValueError: an observation has one of its coordinates only, or lies before that.
    """
    seen = np.isfinite(observed_px)
    if (seen[..., 0] != seen[..., 1]).any():
        raise ValueError("an observation has only one of its two coordinates")
    steps = np.rint((np.where(seen, observed_px, 0.0) + _MARGIN_PX) * _STEPS_PER_PX)
    if (seen & (steps < 0)).any():
        raise ValueError("an observation lies outside of its image")
    return np.where(seen, steps, -1).astype(np.int64)


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
    _, n_parent, _, _, _, _, parent = Reader(data, "map", HEADER_BYTES).unpack(_HEAD)
    return _checked_parent(n_parent, parent)


def encode_map(landmark_map: LandmarkMap) -> bytes:
    """Return the bytes of a map; points and pixels are rounded to their grids.

    Raises:
        ValueError: the map breaks a bound that peers hold every map to.
    """
    m = landmark_map
    if len(m.points_world) and np.abs(m.points_world).max() > MAX_COORDINATE_M:
        raise ValueError(f"a landmark lies further than {MAX_COORDINATE_M:.0f} m from the origin")
    parts = [encode_header(BlobKind.MAP), encode_head(MapHead.of(m))]
    points, pixels = steps_of_points(m.points_world), steps_of_pixels(m.observed_px)
    parts += [encode_column(points[:, axis]) for axis in range(3)]
    for i, keyframe in enumerate(m.keyframes):
        seen = pixels[:, i, 0] >= 0
        parts += [encode_bits(seen), encode_pixels(pixels[seen, i], points[seen], keyframe)]
    data = b"".join(parts)
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
    if len(m.parent) not in (0, REVISION_BYTES):
        raise ValueError(f"a parent revision has 0 or {REVISION_BYTES} bytes: {m.parent!r}")
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
        points = np.stack([take_column(reader, head.n_landmarks) for _ in range(3)], axis=1)
        pixels = np.full((head.n_landmarks, len(head.keyframes), 2), -1, dtype=np.int64)
        for i, keyframe in enumerate(head.keyframes):
            seen = take_bits(reader, head.n_landmarks)
            pixels[seen, i] = take_pixels(reader, points[seen], keyframe)
        reader.finish()
        return head.map_with(points, pixels)
    except ValueError as error:
        raise WireError(f"map: {error}") from None


def take_head(reader: Reader) -> MapHead:
    """Return what comes before the landmarks of a map.

    Raises:
        WireError: the bytes are none.
        ValueError: or are out of bounds.
    """
    detectors, n_parent, n_keyframes, n_distances, n_landmarks, noise_px, parent = reader.unpack(
        _HEAD
    )
    is_anchored = bool(detectors & _ANCHORED)
    if not (detectors & (_ANCHORED - 1) and detectors < 2 * _ANCHORED):
        raise WireError(f"map: unknown detectors {detectors:#x}")
    parent = _checked_parent(n_parent, parent)
    _check_counts(n_landmarks, n_keyframes, n_distances)
    anchor = _take_anchor(reader) if is_anchored else np.zeros((6, 6))
    distances = tuple(KnownDistance(*reader.unpack(_DISTANCE)) for _ in range(n_distances))
    for distance in distances:
        _check_distance(distance)
    return MapHead(
        tuple(_take_keyframe(reader) for _ in range(n_keyframes)),
        n_landmarks,
        noise_px,
        tuple(n for bit, n in enumerate(_DETECTORS) if detectors >> bit & 1),
        distances,
        parent,
        anchor,
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


def _checked_parent(n_bytes: int, padded: bytes) -> bytes:
    """Return the parent revision of its two fields."""
    if n_bytes not in (0, REVISION_BYTES) or padded[n_bytes:].strip(b"\0"):
        raise WireError("map: malformed parent revision")
    return padded[:n_bytes]


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


def encode_pixels(steps: Integers, points: Integers, keyframe: Keyframe) -> bytes:
    """Return the residuals of (n, 2) steps in a keyframe's image that show (n, 3) points.

    Raises:
        ValueError: some lie outside of the image.
    """
    if len(steps) and (steps.min() < 0 or (steps > _largest_steps(keyframe)).any()):
        raise ValueError("an observation lies outside of its image")
    residuals = steps - _expected_steps(points, keyframe)
    return encode_residuals(residuals[:, 0]) + encode_residuals(residuals[:, 1])


def take_pixels(reader: Reader, points: Integers, keyframe: Keyframe) -> Integers:
    """Return the (n, 2) steps in a keyframe's image, of (n, 3) points, that come next.

    Raises:
        WireError: they are none, or lie outside of the image.
    """
    n = len(points)
    residuals = np.stack([take_residuals(reader, n), take_residuals(reader, n)], axis=1)
    steps = residuals + _expected_steps(points, keyframe)
    if n and (steps.min() < 0 or (steps > _largest_steps(keyframe)).any()):
        raise WireError("map: an observation lies outside of its image")
    return steps


def _expected_steps(points: Integers, keyframe: Keyframe) -> Integers:
    """Return (n, 2) steps where a keyframe would see points; the middle if outside or nowhere.

    Arithmetic of two machines differs by 1e-11 of a step: where that moves the rounding, an
    observation is a step off there, and an update made on the other is refused by its revision.
    """
    cam_from_world = (keyframe.world_from_body @ keyframe.body_from_cam).inverse()
    pixels = keyframe.camera.project(cam_from_world.apply(points / _STEPS_PER_M))
    largest = _largest_steps(keyframe)
    with np.errstate(invalid="ignore"):
        steps = np.rint((pixels + _MARGIN_PX) * _STEPS_PER_PX)
        inside = ((steps >= 0) & (steps <= largest)).all(axis=1, keepdims=True)
    return np.where(inside, np.nan_to_num(steps), largest // 2).astype(np.int64)


def _largest_steps(keyframe: Keyframe) -> Integers:
    """Return the (2,) largest value of the columns u, v."""
    camera = keyframe.camera
    size_px = np.array([camera.width_px, camera.height_px], dtype=np.int64)
    return (size_px + int(_MARGIN_PX)) * _STEPS_PER_PX


def _check_counts(n_landmarks: int, n_keyframes: int, n_distances: int) -> None:
    """Raise ValueError for counts out of bounds, before any work is done for them."""
    if not 1 <= n_keyframes <= MAX_KEYFRAMES:
        raise ValueError(f"{n_keyframes} keyframes, allowed 1 to {MAX_KEYFRAMES}")
    if n_landmarks > MAX_LANDMARKS or n_landmarks * n_keyframes > MAX_CELLS:
        raise ValueError(f"{n_landmarks} landmarks in {n_keyframes} keyframes are too many")
    if n_distances > MAX_DISTANCES:
        raise ValueError(f"{n_distances} known distances, at most {MAX_DISTANCES}")


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
