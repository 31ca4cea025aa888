"""What is believed where a fix contradicts the prediction: the fix, the attitude, or neither.

A fix whose position the covariances cannot explain (a relocalization, a prediction gone
wrong) replaces the position and counts as a jump; the farther that was, the less is known
of the speed. One whose rotation contradicts the autopilot's turn since the last fix is wrong:
repeated structure, a planar twin; but for a few degrees at the place where the drone was
expected, or more where nearly all of the map's patches agree: these are the
autopilot's own. Where it sends no attitude, a jump replaces the rotation as well.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.localization.filter_state import (
    GATE_POSE,
    OFFSET,
    POSITION,
    VELOCITY,
    FilterState,
    Measurement,
    unknown,
)
from vcl_companion.localization.fix import Localized, NotLocalized

# 99.99 % of chi^2 with 3 degrees of freedom: beyond, it is not noise.
_GATE_ROTATION, _GATE_POSITION = 21.1, 21.1
# An autopilot that takes its attitude from our poses in part, as it does while they begin, errs
# by degrees that its noise does not tell of: by 3, and where our first poses come late by 12. More
# than the former is believed of it only where what is seen leaves no doubt: so many patches of the
# map, and so large a share of those tried, are where they should be at no wrong place.
_MOST_TURNED_RAD, _MOST_TURNED_SEEN_RAD = np.deg2rad(6.0), np.deg2rad(20.0)
_SEEN_PATCHES, _SEEN_SHARE = 200, 0.8
# What is known after a jump, 1 sigma: nothing.
_FORGOTTEN_M, _FORGOTTEN_M_S, _FORGOTTEN_RAD = 1e3, 10.0, np.pi
# What made a jump went on for so long.
_JUMPED_WITHIN_S = 0.5


def reconciled(
    predicted: FilterState, fix: Localized, measured: Measurement
) -> FilterState | NotLocalized:
    """Return what is to be believed of a prediction in the face of a fix, or why of this nothing.

    Args:
        predicted: with the keyframes of the fix's map.
        fix: of the same instant.
        measured: the same fix as the filter takes it.

    Returns:
        The prediction: as it is, knowing less of the attitude's offset, or nothing of where the
        drone is. Or why the fix is refused.
    """
    innovation = measured.innovation
    expected = measured.expected_by(predicted.covariance)
    distance = innovation[3:] @ np.linalg.solve(expected[3:, 3:], innovation[3:])
    if distance > _GATE_ROTATION and predicted.ned_from_body is not None:
        turned_rad = float(np.linalg.norm(innovation[3:]))
        away = innovation[:3] @ np.linalg.solve(expected[:3, :3], innovation[:3])
        most_rad = _MOST_TURNED_SEEN_RAD if _leaves_no_doubt(fix) else _MOST_TURNED_RAD
        if turned_rad > most_rad or away > _GATE_POSITION:
            return NotLocalized(
                f"turned {np.rad2deg(turned_rad):.0f} degrees against the autopilot's attitude",
                fix.n_matched,
                fix.n_inliers,
            )
        predicted = _doubting_attitude(predicted, turned_rad)
        expected = measured.expected_by(predicted.covariance)
    if innovation @ np.linalg.solve(expected, innovation) > GATE_POSE:
        return _forgotten(predicted, float(np.linalg.norm(innovation[:3])))
    return predicted


def _leaves_no_doubt(fix: Localized) -> bool:
    """Whether so many of the map's patches are where they should be that the pose is right."""
    enough = fix.n_inliers >= max(_SEEN_PATCHES, _SEEN_SHARE * fix.n_matched)
    return fix.by == "patches" and enough


def _doubting_attitude(state: FilterState, turned_rad: float) -> FilterState:
    """Return the state with the attitude's offset as uncertain as it has just been seen to be."""
    covariance = state.covariance.copy()
    covariance[OFFSET, OFFSET] += turned_rad**2 * np.eye(3)
    return replace(state, covariance=covariance)


def _forgotten(state: FilterState, jump_m: float) -> FilterState:
    """Return the state that knows nothing of where it is; with an autopilot, how it is turned.

    Who was not where it was believed to be did not fly as believed either, the less the farther.
    """
    forgotten = [(POSITION, _FORGOTTEN_M)]
    if state.ned_from_body is None:
        forgotten.append((OFFSET, _FORGOTTEN_RAD))
    off_m_s = jump_m / _JUMPED_WITHIN_S
    if off_m_s < _FORGOTTEN_M_S:
        velocity, covariance = state.velocity_world, unknown(state.covariance, forgotten)
        covariance[VELOCITY, VELOCITY] += off_m_s**2 * np.eye(3)
    else:
        forgotten.append((VELOCITY, _FORGOTTEN_M_S))
        velocity, covariance = np.zeros(3), unknown(state.covariance, forgotten)
    return replace(state, covariance=covariance, velocity_world=velocity, n_jumps=state.n_jumps + 1)
