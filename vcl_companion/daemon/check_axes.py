"""Before flight: whether the camera sits as it is configured, and axes are what they should be.

Turned by hand, the drone's camera sees by how much it turned, and the autopilot says it: what takes
the one's turns to the other's is how the camera sits (``geometry/hand_eye.py``).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vcl_companion.cameras.mounting import mounted_rotation, mounting_of, mounting_text
from vcl_companion.daemon.check_host import Check
from vcl_companion.daemon.check_motion import Motion
from vcl_companion.daemon.swapped_axes import Windows, swapped_axes
from vcl_companion.geometry.hand_eye import AxesFit, fit_axes, turned_about
from vcl_companion.geometry.rotation import Array, angle_between

_OFF_DEG = 20.0
# So much has to be turned about a second axis for the mounting, about a third for its handedness.
_LEAST_DEG = 25.0
# Turns in a window that are less than this are no more than their noise.
_LEAST_WINDOW_DEG = 1.0
_LEAST_WINDOWS = 8
# What is left of turns that agree, as a share of them, and of those that leave no doubt.
_AGREES, _DOUBTFUL = 0.4, 0.15
# A mounting is as likely square as that.
_SQUARE_DEG, _STEP_DEG = 7.0, 5.0
_LATE_S = 0.03
_SHIFTS_S = np.linspace(-0.3, 0.3, 31)
# Turns that tell of a shift: how alike they are, and how much less 0.1 s aside.
_ALIKE, _FLAT, _FLAT_SIZES, _ASIDE = 0.8, 0.005, 0.03, 5
_ADVICE = "hold it in the hands, and tilt it to all sides by 30 degrees or more: vcl check --tilt"

_ADVICE_DARK = "the camera sees too little to follow: light, sharpness, something with corners"


def judge_axes(motion: Motion, body_from_cam: Array) -> list[Check]:
    """Judge a motion.

    Args:
        motion: what was seen and said of it.
        body_from_cam: (3, 3) as it is configured.
    """
    late_s = latency_s(motion)
    windows = _windows(motion, late_s or 0.0, _LEAST_WINDOW_DEG)
    if len(windows.seen) < _LEAST_WINDOWS:
        n_pairs = len(motion.seen) + motion.n_unseen
        what = f"not judged: of {n_pairs} looks {len(windows.seen)} tell of a turn, seen and said"
        if motion.n_unseen > len(motion.seen):
            return [Check("axes", "warning", what, _ADVICE_DARK)]
        return [Check("axes", "warning", what, _ADVICE)]
    fit = fit_axes(windows.seen, windows.said)
    checks = [_of_windows(windows, fit, body_from_cam, is_timed=late_s is not None)]
    if late_s is not None and fit.misfit <= _AGREES:
        what = f"images are stamped {late_s * 1e3:+.0f} ms after the attitudes of what they show"
        is_late = abs(late_s) > _LATE_S
        advice = f"add {-late_s:+.3f} to camera.time_offset_s" if is_late else ""
        checks.append(Check("latency", "warning" if is_late else "ok", what, advice))
    return checks


def latency_s(motion: Motion) -> float | None:
    """Return by how much images are stamped later than attitudes; None where nothing tells.

    By which shift the turns that are seen go best with those that are said, whatever the axes;
    where none do, by which one at least their sizes go together.
    """
    first_ns, last_ns = (motion.said_ns[0], motion.said_ns[-1]) if motion.said_ns else (0, 0)
    reach_ns = round(_SHIFTS_S[-1] * 1e9)
    inside = [w for w in motion.seen if first_ns + reach_ns < w[0] and w[1] < last_ns - reach_ns]
    if len(inside) < _LEAST_WINDOWS:
        return None
    turns, sizes = [], []
    for shift_s in _SHIFTS_S:
        windows = _windows(Motion(inside, motion.said_ns, motion.said), float(shift_s), 0.0)
        if len(windows.seen) != len(inside):
            return None
        seen, said = windows.seen, windows.said
        # What rotation or reflection can make of them at best: the sum of the singular values.
        alike = float(np.linalg.svd(said.T @ seen, compute_uv=False).sum())
        turns.append(alike / max(float(np.linalg.norm(seen) * np.linalg.norm(said)), 1e-12))
        sizes.append(_correlation(np.linalg.norm(seen, axis=1), np.linalg.norm(said, axis=1)))
    by_turns = _peak_s(turns, _FLAT)
    return _peak_s(sizes, _FLAT_SIZES) if by_turns is None else by_turns


def _peak_s(alike: Sequence[float], flat: float) -> float | None:
    """Return the shift of the highest of values by shift; None where it does not stand out."""
    best = int(np.argmax(alike))
    if not _ASIDE <= best < len(alike) - _ASIDE or alike[best] < _ALIKE:
        return None
    if alike[best] - 0.5 * (alike[best - _ASIDE] + alike[best + _ASIDE]) < flat:
        return None
    before, here, after = alike[best - 1 : best + 2]
    finer = 0.5 * (before - after) / (before - 2.0 * here + after)
    return float(_SHIFTS_S[best] + finer * (_SHIFTS_S[1] - _SHIFTS_S[0]))


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)


def _windows(motion: Motion, late_s: float, least_deg: float) -> Windows:
    """Return what was seen in windows, and said of them so much earlier; small turns left out."""
    seen, starts, ends = [], [], []
    late_ns = round(late_s * 1e9)
    for start_ns, end_ns, turn in motion.seen:
        start, end = motion.said_at(start_ns - late_ns), motion.said_at(end_ns - late_ns)
        if start is None or end is None:
            continue
        size_rad = max(np.linalg.norm(turn), angle_between(start, end))
        if size_rad >= np.deg2rad(least_deg):
            seen.append(turn)
            starts.append(start)
            ends.append(end)
    return Windows(
        np.array(seen).reshape(-1, 3),
        np.array(starts).reshape(-1, 3, 3),
        np.array(ends).reshape(-1, 3, 3),
    )


def _of_windows(windows: Windows, fit: AxesFit, body_from_cam: Array, *, is_timed: bool) -> Check:
    """Judge turns; ``is_timed``: whether at least their sizes go together."""
    about_deg = np.rad2deg(turned_about(windows.said))
    turned = "turned by {:.0f}, {:.0f} and {:.0f} degrees about three axes".format(*about_deg)
    if about_deg[1] < _LEAST_DEG:
        return Check("axes", "warning", f"not judged: {turned}", _ADVICE)
    tells = bool(about_deg[2] >= _LEAST_DEG)
    is_odd = tells and fit.misfit > _DOUBTFUL
    swapped = swapped_axes(windows, body_from_cam, fit.misfit) if is_odd else None
    if swapped is not None:
        advice = "the autopilot's attitude is no rotation of the drone's: no mounting is like this"
        return Check("axes", "failure", f"swapped axes: {swapped}", advice)
    if fit.misfit > _AGREES and is_timed:
        what = "axes that fit no mounting: the drone turns as much as it sees, but about others"
        return Check("axes", "failure", what, "whose attitude is it? is AHRS_ORIENTATION right?")
    if fit.misfit > _AGREES:
        what = f"not judged: what the camera sees and the autopilot says do not fit; {turned}"
        advice = "a scene that stands still and is metres away, slower turns; whose attitude is it?"
        return Check("axes", "warning", what, advice)
    off_deg = _apart_deg(fit.rotation, body_from_cam)
    if off_deg <= _OFF_DEG:
        what = f"{mounting_text(body_from_cam)}; seen {off_deg:.0f} degrees from that"
        return Check("axes", "ok", what)
    likely = _likely_mounting(fit.rotation)
    what = f"{off_deg:.0f} degrees off: seen {mounting_text(mounted_rotation(likely))}; "
    what += f"configured {mounting_text(body_from_cam)}"
    angles = ", ".join(f"{angle:.0f}" for angle in likely)
    advice = f"right would be camera.mounting_deg = [{angles}]"
    if not tells:
        advice += ", unless axes are swapped: turn it about a third axis as well"
    elif _is_mirror_image(fit.rotation, body_from_cam):
        advice += ", unless the image is mirrored"
    advice += "; or the autopilot's own is wrong (AHRS_ORIENTATION, SENS_BOARD_ROT)"
    return Check("axes", "failure", what, advice)


def _likely_mounting(body_from_cam: Array) -> tuple[float, float, float]:
    """Return the angles that somebody would have mounted a camera by that is seen like this."""
    square = min(
        itertools.product((0.0, 90.0, 180.0, -90.0), (0.0, 90.0, -90.0), (0.0, 90.0, 180.0, -90.0)),
        # The first of those that are the same: with as few angles as can be.
        key=lambda one: (
            round(_apart_deg(mounted_rotation(one), body_from_cam), 3),
            np.count_nonzero(one),
        ),
    )
    if _apart_deg(mounted_rotation(square), body_from_cam) < _SQUARE_DEG:
        return square
    roll, pitch, yaw = (_STEP_DEG * round(a / _STEP_DEG) + 0.0 for a in mounting_of(body_from_cam))
    return roll, pitch, yaw


def _apart_deg(a: Array, b: Array) -> float:
    return float(np.rad2deg(angle_between(a, b)))


def _is_mirror_image(seen: Array, configured: Array) -> bool:
    """Whether a camera seems to be turned by half about its right or down axis.

    That is how an image looks that is mirrored about the other: turns are pseudovectors.
    """
    turn = configured.T @ seen
    mirrors = (np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]))
    return any(_apart_deg(turn, mirror) < _OFF_DEG for mirror in mirrors)
