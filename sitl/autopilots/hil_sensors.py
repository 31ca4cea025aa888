"""What the sensors of a flying multicopter say of a motion: HIL_SENSOR of the MAVLink messages.

An inertial unit, a compass and a barometer, each with its noise: PX4 takes a sensor that says the
same twice for stuck. Its propellers shake it in flight, as they do: one that is not shaken, and
flies straight on, PX4 takes for standing on the ground.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.motion import GRAVITY_M_S2, Motion
from vcl_companion.geometry.rotation import Array, matrix_from_quaternion

# The Earth's in central Europe, gauss, but for its declination: who has no GPS does not know it.
_FIELD_NED_GAUSS = np.array([0.21, 0.0, 0.43])
_HOME_ALTITUDE_M = 500.0
_TEMPERATURE_C = 20.0
# ISO 2533, the standard atmosphere
_SEA_PRESSURE_HPA, _SEA_TEMPERATURE_K = 1013.25, 288.15
_LAPSE_K_M, _GAS_J_KG_K = 0.0065, 287.05
_ACCELERATION_NOISE_M_S2, _RATE_NOISE_RAD_S = 0.02, 0.001
_FIELD_NOISE_GAUSS, _HEIGHT_NOISE_M = 0.001, 0.05
_SHAKES_HZ, _SHAKEN_M_S2, _SHAKEN_RAD_S = 60.0, 2.0, 0.05
_PHASES_RAD = np.array([0.0, 2.0, 4.0])
# Bits of fields_updated: acceleration and rates; field; pressure, its altitude, temperature.
_INERTIAL, _FIELD, _PRESSURE = 0b111111, 0b111 << 6, 0b1101 << 9
PERIOD_US = 4000
"""Of the inertial unit; the others speak at each so manieth of its readings."""
_FIELD_EVERY, _PRESSURE_EVERY = 4, 5


@dataclass(frozen=True)
class _Readings:
    """(T, 3), (T, 3), (T, 3) and (T,) along the body's axes; m/s^2, rad/s, gauss, m."""

    forces: Array
    rates: Array
    fields: Array
    altitudes: Array


def hil_sensors(
    motion: Motion,
    since_us: NDArray[np.int64],
    shaken: NDArray[np.bool_],
    rng: np.random.Generator,
) -> list[Any]:
    """Return pymavlink's HIL_SENSOR of each instant.

    Args:
        motion: at T instants.
        since_us: (T,) of them by the autopilot's clock, us: multiples of ``PERIOD_US``.
        shaken: (T,) whether the propellers turn.
        rng: of the noise.
    """
    shakes = np.sin(2e-6 * np.pi * _SHAKES_HZ * since_us[:, None] + _PHASES_RAD) * shaken[:, None]
    read = _read(motion, shakes, rng)
    hpa = _pressure_hpa(read.altitudes)
    messages = []
    for k, at_us in enumerate(since_us.tolist()):
        updated = _INERTIAL
        number = at_us // PERIOD_US
        updated |= _FIELD if number % _FIELD_EVERY == 0 else 0
        updated |= _PRESSURE if number % _PRESSURE_EVERY == 0 else 0
        messages.append(
            dialect.MAVLink_hil_sensor_message(
                at_us, *read.forces[k], *read.rates[k], *read.fields[k],
                hpa[k], 0.0, read.altitudes[k], _TEMPERATURE_C, updated,
            )
        )  # fmt: skip
    return messages


def _read(motion: Motion, shakes: Array, rng: np.random.Generator) -> _Readings:
    n = len(shakes)
    turns = np.array([matrix_from_quaternion(quaternion) for quaternion in motion.quaternions])
    fields = np.einsum("kij,i->kj", turns, _FIELD_NED_GAUSS)
    return _Readings(
        motion.specific_forces_m_s2
        + _SHAKEN_M_S2 * shakes
        + rng.normal(0.0, _ACCELERATION_NOISE_M_S2, (n, 3)),
        motion.angular_rates_rad_s
        + _SHAKEN_RAD_S * shakes
        + rng.normal(0.0, _RATE_NOISE_RAD_S, (n, 3)),
        fields + rng.normal(0.0, _FIELD_NOISE_GAUSS, (n, 3)),
        _HOME_ALTITUDE_M - motion.positions_m[:, 2] + rng.normal(0.0, _HEIGHT_NOISE_M, n),
    )


def _pressure_hpa(altitudes_m: Array) -> Array:
    """Return the standard atmosphere's pressure at (T,) altitudes, hPa."""
    share = 1.0 - _LAPSE_K_M * altitudes_m / _SEA_TEMPERATURE_K
    return np.asarray(_SEA_PRESSURE_HPA * share ** (GRAVITY_M_S2 / (_LAPSE_K_M * _GAS_J_KG_K)))
