"""What the numbers of a scenario file may be: every one, by its key."""

from __future__ import annotations

_SEED = (0, 2**32 - 1)
_PLACE_M = (-10_000, 10_000)
_TURN_DEG = (-360, 360)
_WAY = (-100_000, 100_000)
_GAIN = (0.01, 100)

RANGES: dict[str, tuple[float, float]] = {
    "frame_rate_hz": (0.001, 1000),
    "duration_s": (0.001, 36_000),
    "truth_rate_hz": (0, 1000),
    "start_at_ns": (0, 4 * 10**18),
    "seed": _SEED,
    "camera.width_px": (1, 8192),
    "camera.height_px": (1, 8192),
    "camera.focal_px": (1, 100_000),
    "camera.cx_px": (-100_000, 100_000),
    "camera.cy_px": (-100_000, 100_000),
    "camera.distortion": (-1000, 1000),
    "camera.position_m": (-100, 100),
    "camera.roll_pitch_yaw_deg": _TURN_DEG,
    "image.supersampling": (1, 8),
    "image.blur_px": (0, 50),
    "image.noise_levels": (0, 255),
    "image.gain": _GAIN,
    "image.vignetting": (0, 1),
    "image.jpg_quality": (1, 100),
    "drone.gain": _GAIN,
    "drone.delay_s": (0, 10),
    "drone.tilt_deg": (-90, 90),
    "drone.flight.waypoints": _WAY,
    "drone.flight.lean": (0, 1),
    "drone.flight.sway.amplitude": (-1000, 1000),
    "drone.flight.sway.period_s": (0.01, 36_000),
    "drone.flight.sway.phase_deg": _TURN_DEG,
    "drone.flight.wobble.amplitude_deg": (-180, 180),
    "drone.flight.wobble.period_s": (0.01, 36_000),
    "drone.flight.wobble.phase_deg": _TURN_DEG,
    "drone.mission.stands": _PLACE_M,
    "drone.mission.legs": _PLACE_M,
    "drone.mission.speed_m_s": (0.2, 10),
    "drone.mission.gear_m": (0.01, 2),
    "drone.mission.begins_s": (0, 600),
    "world.seed": _SEED,
    "world.sun_azimuth_deg": _TURN_DEG,
    "world.sun_elevation_deg": (1, 90),
    "world.sun_strength": (0, 10),
    "world.texels_per_m": (2, 200),
    "world.ground_half_m": (1, 1000),
    "world.ground_texels_per_m": (1, 40),
    "world.building.x_m": _PLACE_M,
    "world.building.y_m": _PLACE_M,
    "world.building.facing_deg": _TURN_DEG,
    "world.building.width_m": (2, 300),
    "world.building.depth_m": (2, 300),
    "world.building.height_m": (2, 300),
    "world.building.columns": (0, 100),
    "world.building.floors": (0, 100),
    "world.building.bays": (0, 20),
    "world.building.relief": (0, 10),
    "world.building.detail": (0, 10),
    "world.building.alike": (0, 1),
    "world.building.roof_deg": (5, 70),
    "world.building.seed": _SEED,
    "world.pavement.x_m": _PLACE_M,
    "world.pavement.y_m": _PLACE_M,
    "world.pavement.length_x_m": (0.1, 1000),
    "world.pavement.length_y_m": (0.1, 1000),
    "world.pavement.height_m": (0.01, 10),
    "world.clutter.x_m": _PLACE_M,
    "world.clutter.y_m": _PLACE_M,
    "world.clutter.length_x_m": (0, 1000),
    "world.clutter.length_y_m": (0, 1000),
    "world.clutter.count": (0, 1000),
    "world.clutter.min_size_m": (0.05, 20),
    "world.clutter.max_size_m": (0.05, 20),
    "world.street.from_x_m": _PLACE_M,
    "world.street.from_y_m": _PLACE_M,
    "world.street.to_x_m": _PLACE_M,
    "world.street.to_y_m": _PLACE_M,
    "world.street.road_m": (2, 50),
    "world.street.pavement_m": (0, 50),
    "world.street.parked": (0, 1),
    "world.street.lamp_every_m": (0, 1000),
    "world.street.crossings": (0, 10_000),
    "world.street.seed": _SEED,
    "world.tree.x_m": _PLACE_M,
    "world.tree.y_m": _PLACE_M,
    "world.tree.height_m": (0.5, 60),
    "world.tree.crown_m": (0.5, 60),
}
"""Least and most, by the keys above one another; of an array each number is held to it."""


def out_of_range(value: object, key: str = "", where: str = "") -> str | None:
    """Return what is wrong with the first number that is out of its range, or None.

    Args:
        value: what the file says there, of any type.
        key: the keys above one another, as in ``RANGES``.
        where: the same with the places in arrays.
    """
    if isinstance(value, dict):
        inner = (
            (v, f"{key}.{k}".lstrip("."), f"{where}.{k}".lstrip(".")) for k, v in value.items()
        )
    elif isinstance(value, list):
        inner = ((v, key, f"{where}[{i}]") for i, v in enumerate(value))
    else:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and key in RANGES:
            low, high = RANGES[key]
            if not low <= value <= high:  # not a number, too
                got = f"{value:g}" if isinstance(value, float) else str(value)[:24]
                return f"{where} is {low} to {high}; got {got}"
        return None
    return next(filter(None, (out_of_range(*item) for item in inner)), None)
