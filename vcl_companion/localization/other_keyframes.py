"""A state that goes on with another map: with keyframes that err much as those it was found by.

Each map is made of where the one before put its views, the swarm's next revision as well as a
local map of a drone's own frames. Taken for a second witness, every one of them would take a half
of the variance away, and ten in a flight nearly all of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import (
    GATE_POSE,
    N_OWN,
    OFFSET,
    POSITION,
    FilterState,
    Measurement,
    unknown,
)
from vcl_companion.localization.fix import Localized

# Where nothing is known of a position, 1 sigma.
_ANYWHERE_M = 1e3
# Position and offset are the first six numbers of the error state.
_N_POSE = 6
# Of the largest of the variances along common axes; rounding leaves more.
_SINGULAR = 1e-12


def with_keyframes(state: FilterState, fix: Localized) -> FilterState:
    """Return the state itself on the map that it was found by; on another, with its errors.

    Those are as yet not correlated with the state.
    """
    if state.considers(fix.keyframe_covariance):
        return state
    own = state.covariance[:N_OWN, :N_OWN]
    return _with_keyframes(state, own, np.zeros_like(fix.map_lever), fix)


def on_own_views(state: FilterState, fix: Localized, measured: Measurement) -> FilterState:
    """Return a state that goes on with a new map of our own views.

    What that knows of where it is it has from the state that those views were found by: it is no
    second witness, and errs as the state does, but for what has come since. Where the state has
    learnt better meanwhile, which the fix then contradicts, only its speed is kept.

    Args:
        state: with the keyframes that it was found by.
        fix: by the new map.
        measured: the same, as the filter takes it.
    """
    lever = _lever_of_state(state, fix)
    shared = lever @ fix.keyframe_covariance
    own = state.beside_keyframes()
    own[:_N_POSE, :_N_POSE] += shared @ lever.T
    return _unless_contradicted(_with_keyframes(state, own, shared, fix), measured)


def on_revision(state: FilterState, fix: Localized, measured: Measurement) -> FilterState:
    """Return a state that goes on with another revision of the swarm's map.

    How much of its error that has from the one before is not known. What the two are off is taken
    for the same, as far as the lesser of the two goes, and the rest of the larger for its own;
    what the state owes to the drone's motion since the last frame is none of the map's. Where the
    fix contradicts that, the revision is believed, and only the speed kept.

    Args:
        state: with any keyframes' errors, these are not looked at.
        fix: by that map.
        measured: the same, as the filter takes it.
    """
    lever = _lever_of_state(state, fix)
    by_fix = lever @ fix.keyframe_covariance
    shared = _in_common(_beside_motion(state), by_fix @ lever.T) @ by_fix
    own = state.covariance[:N_OWN, :N_OWN]
    return _unless_contradicted(_with_keyframes(state, own, shared, fix), measured)


def _with_keyframes(state: FilterState, own: Array, shared: Array, fix: Localized) -> FilterState:
    """Return a state with the keyframe errors of a fix's map.

    Args:
        state: with those of any.
        own: (12, 12) covariance of the error state without them.
        shared: (6, 6V) of position and offset with them.
        fix: by the map.
    """
    n = N_OWN + shared.shape[1]
    covariance = np.zeros((n, n))
    covariance[:N_OWN, :N_OWN], covariance[N_OWN:, N_OWN:] = own, fix.keyframe_covariance
    covariance[:_N_POSE, N_OWN:], covariance[N_OWN:, :_N_POSE] = shared, shared.T
    return replace(state, covariance=covariance)


def _beside_motion(state: FilterState) -> Array:
    """Return (6, 6) of position and offset were velocity and the attitude sample's error known."""
    known = state.covariance[:N_OWN, :N_OWN]
    motion, with_motion = known[_N_POSE:, _N_POSE:], known[:_N_POSE, _N_POSE:]
    explained = with_motion @ np.linalg.pinv(motion, hermitian=True) @ with_motion.T
    return np.asarray(known[:_N_POSE, :_N_POSE] - explained)


def _in_common(a: Array, b: Array) -> Array:
    """Return the share (n, n) of an error of covariance ``b`` that is one of covariance ``a``, too.

    Along their common axes the lesser is all of it part of the larger one.
    """
    scales, axes = np.linalg.eigh(a + b)
    known = scales > _SINGULAR * scales[-1]
    root = axes[:, known] * np.sqrt(scales[known])
    whiten = axes[:, known] / np.sqrt(scales[known])
    shares, common = np.linalg.eigh(whiten.T @ a @ whiten)
    of_b = np.clip(shares / np.maximum(1.0 - shares, _SINGULAR), 0.0, 1.0)
    return np.asarray((root @ common * of_b) @ (whiten @ common).T)


def _unless_contradicted(state: FilterState, measured: Measurement) -> FilterState:
    """Return a state as it is, or where a fix contradicts it, knowing its speed alone."""
    expected, innovation = measured.expected_by(state.covariance), measured.innovation
    if innovation @ np.linalg.solve(expected, innovation) <= GATE_POSE:
        return state
    forgotten = unknown(state.covariance, ((POSITION, _ANYWHERE_M), (OFFSET, np.pi)))
    return replace(state, covariance=forgotten)


def _lever_of_state(state: FilterState, fix: Localized) -> Array:
    """Return (6, 6V) what position and offset are off where they are off as a fix's map is."""
    out = np.empty((_N_POSE, fix.map_lever.shape[1]))
    rotation = state.world_from_body.rotation
    out[POSITION], out[OFFSET] = -rotation @ fix.map_lever[:3], -rotation @ fix.map_lever[3:]
    return out
