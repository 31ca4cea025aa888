"""Whether the frame that poses are told in fits what the autopilot's parameters make of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from vcl_companion.daemon.check_host import Check
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.origin import HEIGHT_BY_VISION, HEIGHT_REFERENCE
from vcl_companion.links.vision_pose import Firmware

# AP_NavEKF_Source: SourceYaw; EKF2_EV_CTRL's bit
_YAW_SOURCE, _BY_COMPASS, _BY_US = "EK3_SRC1_YAW", 1, 6
_VISION_CONTROL, _YAW_BIT = "EKF2_EV_CTRL", 8


def of_frames(
    options: AutopilotOptions, firmware: Firmware, values: Mapping[str, float]
) -> Iterator[Check]:
    """Yield what does not fit.

    Args:
        options: ``heading`` and ``origin`` among them.
        firmware: whose parameters.
        values: of those that it has, by name.
    """
    turns_to_us = _turns_to_us(firmware, values)
    if turns_to_us is False and options.heading == "map":
        what = "it flies by its compass, and is told positions in the leader's north"
        yield Check("heading", "warning", what, 'set autopilot.heading = "autopilot"')
    if turns_to_us and options.heading == "autopilot":
        what = "it takes its heading from us, and is told its own"
        yield Check("heading", "warning", what, 'set autopilot.heading = "map"')
    by_vision = round(values.get(HEIGHT_REFERENCE, 0.0)) == HEIGHT_BY_VISION
    if firmware is Firmware.PX4 and by_vision and options.origin is not None:
        what = f"it is not told: with {HEIGHT_REFERENCE} 3 (vision) it would climb away"
        yield Check("origin", "failure", what, f"set {HEIGHT_REFERENCE} to 0, or no origin")
    elif firmware is Firmware.PX4 and by_vision:
        what = f"with {HEIGHT_REFERENCE} 3 (vision) it climbs away when a ground station sets one"
        yield Check("origin", "warning", what, f"have nobody set one, or {HEIGHT_REFERENCE} 0")


def _turns_to_us(firmware: Firmware, values: Mapping[str, float]) -> bool | None:
    """Return whether it takes its heading from our poses; None where that is not said."""
    if firmware is Firmware.ARDUPILOT and _YAW_SOURCE in values:
        return {_BY_COMPASS: False, _BY_US: True}.get(round(values[_YAW_SOURCE]))
    if firmware is Firmware.PX4 and _VISION_CONTROL in values:
        return bool(round(values[_VISION_CONTROL]) & _YAW_BIT)
    return None
