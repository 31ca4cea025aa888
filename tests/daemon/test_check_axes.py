"""A drone that is turned by hand shows how its camera sits, and what is wrong with an attitude."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.daemon import turned_by_hand as by_hand
from vcl_companion.cameras.mounting import mounted_rotation
from vcl_companion.daemon.check_axes import judge_axes, latency_s
from vcl_companion.daemon.check_host import Check
from vcl_companion.daemon.check_motion import Motion
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3
from vcl_companion.vision.image_turn import Image, image_turn

RIGHT = by_hand.MOUNTING_DEG
START_NS = 10**12
ATTITUDE_STEP_S = 0.02
NOISE_RAD = np.deg2rad(0.1)
# Images show the turn between two of them to 0.1 degrees, of 3; a lens that moves by centimetres
# before houses that are metres away, seems to turn with it.
OFF_DEG = 3.0

Changed = Callable[[Rotation], Rotation]


def seen(mounting_deg: tuple[float, float, float] = RIGHT) -> list[tuple[float, float, Array]]:
    """What image after image shows: from when to when, s, and the turn."""
    return _seen(mounting_deg, is_mirrored=False)


@functools.cache
def _seen(
    mounting_deg: tuple[float, float, float], *, is_mirrored: bool
) -> list[tuple[float, float, Array]]:
    images: list[Image] = by_hand.images(mounting_deg)
    if is_mirrored:
        images = [np.ascontiguousarray(image[:, ::-1]) for image in images]
    rng = np.random.default_rng(2)
    out, turned, began = [], np.eye(3), 0
    for k in range(1, len(images)):
        step = image_turn(images[k - 1], images[k], by_hand.LENS, rng)
        assert step is not None
        turned = turned @ step
        if k - began == 2:
            out.append((began / by_hand.RATE_HZ, k / by_hand.RATE_HZ, log_so3(turned)))
            turned, began = np.eye(3), k
    return out


def moved(
    turns: list[tuple[float, float, Array]],
    said_of: Changed = lambda attitude: attitude,
    late_s: float = 0.0,
) -> Motion:
    """The motion with an autopilot that says ``said_of`` of its attitude, and late images."""
    rng = np.random.default_rng(3)
    motion = Motion([(_ns(s + late_s), _ns(e + late_s), turn) for s, e, turn in turns])
    for k in range(-20, round((by_hand.SECONDS + 1.0) / ATTITUDE_STEP_S)):
        at_s = k * ATTITUDE_STEP_S
        true = by_hand.world_from_body(max(at_s, 0.0)).rotation
        measured = Rotation.from_matrix(true @ exp_so3(rng.normal(0.0, NOISE_RAD, 3)))
        motion.said_ns.append(_ns(at_s))
        motion.said.append(said_of(measured).as_matrix())
    return motion


def _ns(at_s: float) -> int:
    return START_NS + round(at_s * 1e9)


def axes(checks: list[Check]) -> Check:
    return checks[0]


def test_a_right_mounting_is_right_to_degrees_and_images_are_in_time() -> None:
    motion = moved(seen())
    check, latency = judge_axes(motion, mounted_rotation(RIGHT))
    assert (check.grade, check.advice) == ("ok", "")
    off_deg = int(check.what.split("; seen ")[1].split()[0])
    assert off_deg <= OFF_DEG
    assert (latency.name, latency.grade) == ("latency", "ok")


@pytest.mark.parametrize(
    "configured",
    [
        (90.0, -10.0, 0.0), (-90.0, -10.0, 0.0), (180.0, -10.0, 0.0),
        (0.0, 80.0, 0.0), (0.0, -100.0, 0.0),
        (0.0, -10.0, 90.0), (0.0, -10.0, -90.0), (0.0, -10.0, 180.0),
    ],
)  # fmt: skip
def test_a_mounting_that_is_configured_wrong_is_named_with_the_right_one(
    configured: tuple[float, float, float],
) -> None:
    check = axes(judge_axes(moved(seen()), mounted_rotation(configured)))
    assert check.grade == "failure"
    assert check.what.startswith(("90 degrees off", "89 deg", "91 deg", "180 deg", "179 deg"))
    assert "camera.mounting_deg = [0, -10, 0]" in check.advice


@pytest.mark.parametrize(
    "mounted", [(90.0, 0.0, 0.0), (0.0, -90.0, 0.0), (0.0, 0.0, 90.0)], ids=["roll", "pitch", "yaw"]
)
def test_a_camera_that_is_screwed_on_otherwise_is_seen(
    mounted: tuple[float, float, float],
) -> None:
    motion = moved(seen(mounted))
    check = axes(judge_axes(motion, mounted_rotation((0.0, 0.0, 0.0))))
    assert check.grade == "failure"
    angles = ", ".join(f"{angle:.0f}" for angle in mounted)
    assert f"camera.mounting_deg = [{angles}]" in check.advice
    assert axes(judge_axes(motion, mounted_rotation(mounted))).grade == "ok"


@pytest.mark.parametrize(("off_deg", "grade"), [(15.0, "ok"), (25.0, "failure")])
def test_twenty_degrees_are_the_bound(off_deg: float, grade: str) -> None:
    configured = mounted_rotation((0.0, RIGHT[1] + off_deg, 0.0))
    assert axes(judge_axes(moved(seen()), configured)).grade == grade


def with_quaternion(order: tuple[int, int, int], signs: tuple[int, int, int]) -> Changed:
    """An attitude of whose quaternion components are told in another order, or negated."""

    def said_of(attitude: Rotation) -> Rotation:
        x, y, z, w = attitude.as_quat()
        told = np.array([x, y, z])[list(order)] * signs
        return Rotation.from_quat([*told, w])

    return said_of


def with_angles(order: tuple[int, int, int], signs: tuple[int, int, int]) -> Changed:
    """An attitude whose roll, pitch and yaw are told in another order, or negated."""

    def said_of(attitude: Rotation) -> Rotation:
        yaw, pitch, roll = attitude.as_euler("ZYX")
        told = np.array([roll, pitch, yaw])[list(order)] * signs
        return Rotation.from_euler("ZYX", told[::-1])

    return said_of


@pytest.mark.parametrize(
    ("said_of", "what"),
    [
        (with_quaternion((1, 0, 2), (1, 1, 1)), "x comes as y, y comes as x of the quaternion"),
        (with_quaternion((0, 2, 1), (1, 1, 1)), "y comes as z, z comes as y of the quaternion"),
        (with_quaternion((0, 1, 2), (1, -1, 1)), "y comes as minus y of the quaternion"),
        (with_angles((1, 0, 2), (1, 1, 1)), "roll comes as pitch, pitch comes as roll"),
        (with_angles((0, 1, 2), (1, 1, -1)), "yaw comes as minus yaw of the angles"),
        (with_angles((0, 1, 2), (1, -1, 1)), "pitch comes as minus pitch of the angles"),
    ],
)
def test_swapped_axes_of_an_attitude_are_named(said_of: Changed, what: str) -> None:
    check = axes(judge_axes(moved(seen(), said_of), mounted_rotation(RIGHT)))
    assert check.grade == "failure"
    assert check.what.startswith("swapped axes: ")
    assert what in check.what


def test_gyroscopes_with_swapped_axes_are_named() -> None:
    """What integrates roll for pitch and pitch for roll tells an attitude of another motion."""
    motion = moved(seen())
    swap = np.eye(3)[[1, 0, 2]]
    integrated = [np.eye(3)]
    for k in range(1, len(motion.said)):
        turn = log_so3(motion.said[k - 1].T @ motion.said[k])
        integrated.append(integrated[-1] @ exp_so3(swap @ turn))
    motion.said[:] = integrated
    check = axes(judge_axes(motion, mounted_rotation(RIGHT)))
    assert check.grade == "failure"
    assert check.what == "swapped axes: roll comes as pitch, pitch comes as roll"


def test_the_attitude_of_another_drone_is_no_mounting() -> None:
    motion = moved(seen())
    motion.said[:] = motion.said[::-1]
    check = axes(judge_axes(motion, mounted_rotation(RIGHT)))
    assert check.grade in ("warning", "failure")
    assert "fit" in check.what


def test_a_mirrored_image_is_thought_of() -> None:
    turns = _seen(RIGHT, is_mirrored=True)
    check = axes(judge_axes(moved(turns), mounted_rotation(RIGHT)))
    assert check.grade == "failure"
    assert "unless the image is mirrored" in check.advice


@pytest.mark.parametrize("late_s", [-0.08, 0.0, 0.05, 0.12])
def test_images_that_are_stamped_late_are_told_by_how_much(late_s: float) -> None:
    motion = moved(seen(), late_s=late_s)
    told = latency_s(motion)
    assert told is not None
    assert told == pytest.approx(late_s, abs=0.01)
    check, latency = judge_axes(motion, mounted_rotation(RIGHT))
    assert check.grade == "ok"
    assert latency.grade == ("warning" if late_s else "ok")
    if late_s:
        added_s = float(latency.advice.split("add ")[1].split()[0])
        assert added_s == pytest.approx(-late_s, abs=0.01)


@pytest.mark.parametrize("turned", ["not at all", "about one axis"])
def test_too_little_motion_is_not_judged(turned: str) -> None:
    motion = moved(seen())
    about = np.array([1.0 if turned == "about one axis" else 0.0, 0.0, 0.0])
    said = [exp_so3(0.6 * about * np.sin(1.5 * (ns - START_NS) * 1e-9)) for ns in motion.said_ns]
    motion.said[:] = said
    sits = mounted_rotation(RIGHT)
    for k, (start, end, _) in enumerate(motion.seen):
        turn = motion.said_at(start), motion.said_at(end)
        assert turn[0] is not None
        assert turn[1] is not None
        motion.seen[k] = (start, end, sits.T @ log_so3(turn[0].T @ turn[1]))
    check = axes(judge_axes(motion, mounted_rotation((90.0, 0.0, 0.0))))
    assert check.grade == "warning"
    assert check.what.startswith("not judged: ")
    assert "vcl check --tilt" in check.advice


def test_without_an_attitude_nothing_is_judged() -> None:
    motion = moved(seen())
    check = axes(judge_axes(Motion(motion.seen), mounted_rotation(RIGHT)))
    assert check.grade == "warning"
    assert axes(judge_axes(Motion(), mounted_rotation(RIGHT))).grade == "warning"


def test_a_camera_that_sees_nothing_is_told_so() -> None:
    check = axes(judge_axes(Motion(n_unseen=40), mounted_rotation(RIGHT)))
    assert check.grade == "warning"
    assert "sees too little" in check.advice
