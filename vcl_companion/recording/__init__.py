"""The recording format: reader beside writer, and importers from AirSim and KITTI."""

from vcl_companion.recording.description import Description, KnownPair
from vcl_companion.recording.images import check_image, load_image
from vcl_companion.recording.recording import Drone, FrameFile, Recording, read_recording
from vcl_companion.recording.sensor import (
    BODY_FROM_CAM_FORWARD,
    NED_FROM_REFERENCE,
    ReferenceAxes,
    Sensor,
    read_sensor,
    write_sensor,
)
from vcl_companion.recording.trajectory import InertialSamples, Trajectory
from vcl_companion.recording.writer import ImageOptions, RecordingWriter

__all__ = [
    "BODY_FROM_CAM_FORWARD",
    "NED_FROM_REFERENCE",
    "Description",
    "Drone",
    "FrameFile",
    "ImageOptions",
    "InertialSamples",
    "KnownPair",
    "Recording",
    "RecordingWriter",
    "ReferenceAxes",
    "Sensor",
    "Trajectory",
    "check_image",
    "load_image",
    "read_recording",
    "read_sensor",
    "write_sensor",
]
