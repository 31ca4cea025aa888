"""Poses and cameras as bytes, the parts that frames and maps share.

A rotation travels as four integers proportional to its quaternion, the largest
scaled to exactly 2^30: 1e-9 rad fine, a rotation by construction, and the
decoded matrix gives the same integers again (a rounded unit quaternion would
not: normalising moves it off its own rounding).
"""

from __future__ import annotations

import math
import struct

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.wire.reader import Reader

MAX_COORDINATE_M = 32_000.0
MAX_IMAGE_SIDE_PX = 8192
# Finding features takes some 400 bytes a pixel: a peer must not make it gigabytes.
MAX_IMAGE_PX = 1 << 22
MAX_IMAGE_BYTES = 1024 * 1024

_UNIT = 1 << 30

# Rotation: | 0 | 4 x i32 | w x y z times 2^30 / largest; the first largest one is +2^30 |
_ROTATION = struct.Struct("<4i")

# Pose: a rotation, then | 16 | 3 x f64 | translation, m |
_TRANSLATION = struct.Struct("<3d")

# Camera
# | 0  | 2 x u16 | width, height, px                                       |
# | 4  | 4 x f64 | fx, fy, cx, cy, px                                      |
# | 36 | u8      | model: 0 none, 1 radial-tangential, 2 equidistant       |
# | 37 | u8      | number of coefficients k                                |
# | 38 | k x f64 | coefficients                                            |
_CAMERA = struct.Struct("<2H4d2B")
_MODELS: tuple[DistortionModel, ...] = ("none", "radial-tangential", "equidistant")
_MAX_COEFFICIENTS = 5
_MAX_COEFFICIENT = 1e3

# Image: | 0 | u32 | bytes n | then | 4 | n | the encoded image |
_LENGTH = struct.Struct("<I")


def encode_rotation(quaternion: Array) -> bytes:
    """Return the 16 bytes of a (4,) quaternion w x y z of any length but zero.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    largest = float(np.abs(quaternion).max())
    if not math.isfinite(largest) or largest < 1e-9:
        raise ValueError(f"not a rotation: quaternion {quaternion.tolist()}")
    scaled = [round(float(value) / largest * _UNIT) for value in quaternion]
    if next(value for value in scaled if abs(value) == _UNIT) < 0:
        scaled = [-value for value in scaled]
    return _ROTATION.pack(*scaled)


def take_rotation(reader: Reader) -> Array:
    """Return the (4,) unit quaternion w x y z that comes next, its largest part positive."""
    scaled = reader.unpack(_ROTATION)
    if max(map(abs, scaled)) != _UNIT:
        raise WireError(f"a rotation is not normalised: {scaled}")
    if next(value for value in scaled if abs(value) == _UNIT) < 0:
        raise WireError(f"a rotation has the wrong sign: {scaled}")
    quaternion = np.array(scaled, dtype=np.float64)
    return np.asarray(quaternion / np.linalg.norm(quaternion))


def encode_pose(pose: Pose) -> bytes:
    """Return the 40 bytes of a pose.

    Raises:
        ValueError: a coordinate beyond ``MAX_COORDINATE_M``.
    """
    if np.abs(pose.translation).max() > MAX_COORDINATE_M:
        raise ValueError(f"a pose lies out of range: {pose.translation.tolist()} m")
    return encode_rotation(pose.quaternion()) + _TRANSLATION.pack(*pose.translation)


def take_pose(reader: Reader) -> Pose:
    """Return the pose that comes next."""
    quaternion = take_rotation(reader)
    translation = np.array(reader.unpack(_TRANSLATION))
    if not np.abs(translation).max() <= MAX_COORDINATE_M:
        raise WireError(f"a pose lies out of range: {translation.tolist()} m")
    return Pose.from_quaternion(quaternion, translation)


def rounded_pose(pose: Pose) -> Pose:
    """Return a pose as whoever reads its bytes has it; one that was read stays as it is.

    Raises:
        ValueError: see ``encode_pose``.
    """
    return take_pose(Reader(encode_pose(pose), "pose"))


def encode_camera(camera: Camera) -> bytes:
    """Return the bytes of a camera.

    Raises:
        ValueError: an image larger than peers accept, or absurd intrinsics.
    """
    check_camera(camera)
    head = _CAMERA.pack(
        camera.width_px,
        camera.height_px,
        camera.fx_px,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
        _MODELS.index(camera.distortion_model),
        len(camera.distortion),
    )
    return head + struct.pack(f"<{len(camera.distortion)}d", *camera.distortion)


def take_camera(reader: Reader) -> Camera:
    """Return the camera that comes next."""
    width, height, fx, fy, cx, cy, model, n_coefficients = reader.unpack(_CAMERA)
    if model >= len(_MODELS) or n_coefficients > _MAX_COEFFICIENTS:
        raise WireError(f"unknown camera model {model} with {n_coefficients} coefficients")
    distortion = reader.unpack(struct.Struct(f"<{n_coefficients}d"))
    try:
        camera = Camera(width, height, fx, fy, cx, cy, _MODELS[model], distortion)
        check_camera(camera)
    except ValueError as error:
        raise WireError(str(error)) from None
    return camera


def encode_image(image_bytes: bytes) -> bytes:
    """Return an encoded image with its length before it.

    Raises:
        ValueError: empty or longer than peers accept.
    """
    if not 0 < len(image_bytes) <= MAX_IMAGE_BYTES:
        raise ValueError(f"an image of {len(image_bytes)} bytes, allowed 1 to {MAX_IMAGE_BYTES}")
    return _LENGTH.pack(len(image_bytes)) + image_bytes


def take_image(reader: Reader) -> bytes:
    """Return the encoded image that comes next, as it is: nothing here decodes it."""
    (n_bytes,) = reader.unpack(_LENGTH)
    if not 0 < n_bytes <= MAX_IMAGE_BYTES:
        raise WireError(f"an image of {n_bytes} bytes, allowed 1 to {MAX_IMAGE_BYTES}")
    return reader.take(n_bytes)


def check_camera(camera: Camera) -> None:
    """Raise ValueError for intrinsics no lens has: they would overflow the arithmetic later."""
    side = max(camera.width_px, camera.height_px)
    if side > MAX_IMAGE_SIDE_PX:
        raise ValueError(f"camera: image side {side} px, at most {MAX_IMAGE_SIDE_PX}")
    focal = (camera.fx_px, camera.fy_px)
    if camera.width_px * camera.height_px > MAX_IMAGE_PX:
        raise ValueError(
            f"camera: {camera.width_px}x{camera.height_px} px, at most {MAX_IMAGE_PX} in all"
        )
    if min(focal) < 0.01 * side or max(focal) > 1000.0 * side:
        raise ValueError(f"camera: focal lengths {focal} px for an image side of {side} px")
    if max(abs(camera.cx_px), abs(camera.cy_px)) > 10.0 * side:
        raise ValueError(f"camera: principal point far outside: {camera.cx_px}, {camera.cy_px}")
    if any(abs(value) > _MAX_COEFFICIENT for value in camera.distortion):
        raise ValueError(f"camera: distortion {camera.distortion}")
