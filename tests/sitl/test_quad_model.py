"""The model of a quad against what mechanics says of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitl.autopilots.motion import GRAVITY_M_S2
from sitl.autopilots.quad_model import MASS_KG, MAX_THRUST_N, QuadModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import euler_from_matrix, matrix_from_euler

STEP_S = 0.004
GEAR_M = 0.25
HOVERS = MASS_KG * GRAVITY_M_S2 / (4 * MAX_THRUST_N)
STANDS = Pose(matrix_from_euler(0.0, 0.0, 0.7), np.array([3.0, -2.0, -GEAR_M]))


def high_up(height_m: float = 100.0) -> QuadModel:
    """One in the air, level and at rest: the ground is far below."""
    return QuadModel(Pose(STANDS.rotation, STANDS.translation - [0.0, 0.0, height_m]), GEAR_M)


def fly(quad: QuadModel, commands: list[float], seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        quad.step(np.array(commands), STEP_S)


def hovering() -> QuadModel:
    """One whose propellers bear it, at nearly no speed."""
    quad = high_up()
    # What the propellers lack while they speed up they give afterwards.
    fly(quad, [1.0] * 4, 0.05)
    fly(quad, [HOVERS] * 4, 1.0)
    return quad


@pytest.mark.parametrize("gear_m", [0.05, GEAR_M, 2.0])
def test_it_stands_where_it_was_put_and_feels_its_weight(gear_m: float) -> None:
    stands = Pose(STANDS.rotation, np.array([3.0, -2.0, -gear_m]))
    quad = QuadModel(stands, gear_m)
    fly(quad, [0.0] * 4, 10.0)
    motion = quad.motion()
    np.testing.assert_allclose(quad.ned_from_body().local(stands), 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.specific_forces_m_s2, [[0, 0, -GRAVITY_M_S2]], atol=1e-9)
    assert not quad.turns


def test_without_thrust_it_falls_to_the_speed_at_which_drag_bears_it() -> None:
    quad = high_up(1e6)
    fly(quad, [0.0] * 4, 1.0)
    # Drag of 1 N s/m on 1 kg: v = g (1 - exp(-t))
    down_m_s = GRAVITY_M_S2 * (1.0 - np.exp(-1.0))
    assert quad.motion().velocities_m_s[0, 2] == pytest.approx(down_m_s, rel=0.005)
    fly(quad, [0.0] * 4, 20.0)
    assert quad.motion().velocities_m_s[0, 2] == pytest.approx(GRAVITY_M_S2, rel=1e-6)
    np.testing.assert_allclose(
        quad.motion().specific_forces_m_s2, [[0, 0, -GRAVITY_M_S2]], rtol=1e-6, atol=1e-12
    )


def test_propellers_bear_its_weight_and_lag_behind_their_commands() -> None:
    quad = hovering()
    np.testing.assert_allclose(
        quad.motion().specific_forces_m_s2[0, 2],
        -GRAVITY_M_S2,
        atol=0.01 + abs(quad.motion().velocities_m_s[0, 2]),
    )
    before = quad.motion().velocities_m_s[0, 2]
    fly(quad, [1.0] * 4, 0.048)
    # A lag of 0.05 s, to two thirds of the change by then.
    full = (4 * MAX_THRUST_N - MASS_KG * GRAVITY_M_S2) / MASS_KG
    climbed = before - quad.motion().velocities_m_s[0, 2]
    assert 0.3 * full * 0.048 < climbed < 0.5 * full * 0.048
    assert quad.turns


@pytest.mark.parametrize(
    ("more", "turns"),
    [
        ((1, 2), (1.0, 0.0, 0.0)),  # the left ones: its right side goes down
        ((0, 2), (0.0, 1.0, 0.0)),  # the front ones: its nose goes up
        ((0, 1), (0.0, 0.0, 1.0)),  # one diagonal: it turns to the right
    ],
)
def test_propellers_turn_it_about_each_axis_alone(
    more: tuple[int, int], turns: tuple[float, float, float]
) -> None:
    quad = hovering()
    commands = [HOVERS + (0.05 if n in more else -0.05) for n in range(4)]
    fly(quad, commands, 0.2)
    rates = quad.motion().angular_rates_rad_s[0]
    assert rates @ turns > 0.05
    np.testing.assert_allclose(rates, (rates @ turns) * np.array(turns), atol=1e-9)


def test_it_flies_where_it_leans() -> None:
    quad = hovering()
    fly(quad, [HOVERS + 0.02, HOVERS - 0.02, HOVERS + 0.02, HOVERS - 0.02], 0.1)
    fly(quad, [HOVERS] * 4, 1.0)
    back = quad.ned_from_body().rotation.T @ quad.motion().velocities_m_s[0]
    assert back[0] < -0.2  # nose up, so backwards
    assert abs(back[1]) < 1e-9


def test_its_sensors_integrate_to_its_motion() -> None:
    quad = hovering()
    rng = np.random.default_rng(3)
    begins = quad.motion()
    turn = Rotation.from_quat(np.roll(begins.quaternions[0], -1))
    velocity = begins.velocities_m_s[0]
    for _ in range(500):
        rotation = turn
        quad.step(HOVERS + rng.uniform(-0.02, 0.02, 4), STEP_S)
        felt = quad.motion()
        turn = turn * Rotation.from_rotvec(STEP_S * felt.angular_rates_rad_s[0])
        force = rotation.apply(felt.specific_forces_m_s2[0])
        velocity = velocity + STEP_S * (force + np.array([0.0, 0.0, GRAVITY_M_S2]))
    ends = quad.motion()
    np.testing.assert_allclose(velocity, ends.velocities_m_s[0], atol=1e-9)
    off = turn.inv() * Rotation.from_quat(np.roll(ends.quaternions[0], -1))
    assert off.magnitude() < 1e-9
    assert np.linalg.norm(ends.velocities_m_s - begins.velocities_m_s) > 0.01
    ahead = quad.ned_from_body(0.002)
    assert np.linalg.norm(ahead.translation - ends.positions_m[0]) == pytest.approx(
        0.002 * np.linalg.norm(ends.velocities_m_s), rel=1e-6
    )


def test_it_takes_off_lands_on_its_feet_and_stays_there() -> None:
    quad = QuadModel(STANDS, GEAR_M)
    fly(quad, [0.80] * 4, 0.2)
    fly(quad, [0.85, 0.80, 0.80, 0.75], 0.2)
    roll, pitch, _ = euler_from_matrix(quad.ned_from_body().rotation)
    assert quad.ned_from_body().translation[2] < -GEAR_M - 0.1
    assert np.hypot(roll, pitch) > 0.02
    hardest_m_s2 = 0.0
    for _ in range(750):
        quad.step(np.zeros(4), STEP_S)
        hardest_m_s2 = max(hardest_m_s2, float(np.abs(quad.motion().specific_forces_m_s2).max()))
    # An inertial unit of 16 g is not overcome.
    assert 20.0 < hardest_m_s2 < 150.0
    roll, pitch, _ = euler_from_matrix(quad.ned_from_body().rotation)
    np.testing.assert_allclose((roll, pitch), 0.0, atol=1e-6)
    assert quad.ned_from_body().translation[2] == pytest.approx(-GEAR_M, abs=1e-6)
    np.testing.assert_allclose(quad.motion().velocities_m_s, 0.0, atol=1e-6)
    assert np.linalg.norm(quad.ned_from_body().translation[:2] - STANDS.translation[:2]) < 0.3
