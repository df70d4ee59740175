"""Commands to the simulation: limits, replacement, holding, and refusal of invalid ones."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    ARM_JOINTS,
    FINGER_JOINT,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_simulation.engine import Engine
from rn_simulation.setpoint import JointSetpoint
from roboneuron.errors import InvalidInputError, StateError


@pytest.fixture
def simulation(engine: Engine) -> Iterator[ArmSimulation]:
    with ArmSimulation(0, colours=("red",), engine=engine) as simulation:
        yield simulation


def test_target_is_reached_in_the_time_given(simulation: ArmSimulation) -> None:
    target = np.array(HOME_RAD) + 0.1
    sent = simulation.set_target(ARM_JOINTS, target, 0.5)
    assert sent.duration_s == 0.5
    # 0.1 s longer: the setpoint brakes at the end, and the motors lag a few steps.
    simulation.step(round(0.6 / STEP_S))
    np.testing.assert_allclose(simulation.joint_positions()[:7], target, atol=2e-3)


def test_measured_velocity_stays_below_the_official_limit(simulation: ArmSimulation) -> None:
    sent = simulation.set_target(["fr3_joint1"], [2.5], 0.05)
    assert sent.duration_s > 2.5 / VELOCITY_RAD_S[0]
    fastest = 0.0
    for _ in range(round(sent.duration_s / STEP_S) + 24):
        simulation.step()
        fastest = max(fastest, float(np.abs(simulation.joint_states()[1][0])))
    # The motor may slightly overshoot the velocity of its setpoint.
    assert VELOCITY_RAD_S[0] * 0.9 < fastest < VELOCITY_RAD_S[0] * 1.02
    assert simulation.joint_positions()[0] == pytest.approx(2.5, abs=2e-3)


def test_position_beyond_a_limit_is_clamped_and_reported(simulation: ArmSimulation) -> None:
    sent = simulation.set_target(["fr3_joint1", FINGER_JOINT], [9.0, -1.0], 1.0)
    np.testing.assert_array_equal(sent.position, [UPPER_RAD[0], 0.0])


def test_setpoint_is_smooth_when_targets_change_at_any_moment() -> None:
    random = np.random.default_rng(3)
    velocity_limit, acceleration_limit = np.array(VELOCITY_RAD_S), np.array(ACCELERATION_RAD_S2)
    setpoint = JointSetpoint(np.zeros(7), velocity_limit, acceleration_limit)
    for _ in range(100):
        setpoint.aim(random.uniform(-1, 1, 7), range(7), float(random.uniform(0.01, 1.0)))
        for _ in range(int(random.integers(1, 60))):
            before = setpoint.velocity.copy()
            setpoint.advance(STEP_S)
            assert (np.abs(setpoint.velocity) <= velocity_limit + 1e-9).all()
            assert (np.abs(setpoint.velocity - before) <= acceleration_limit * STEP_S + 1e-9).all()
            # Targets lie within 1 rad; a reversal may overshoot one, never by more than its braking
            # distance.
            assert (
                np.abs(setpoint.position) <= 1.0 + velocity_limit**2 / (2 * acceleration_limit)
            ).all()
    for _ in range(1200):
        setpoint.advance(STEP_S)
    np.testing.assert_allclose(setpoint.position, setpoint.target, atol=1e-9)


def test_hold_brakes_without_a_jump_and_stays(simulation: ArmSimulation) -> None:
    simulation.set_target(["fr3_joint1"], [1.5], 1.0)
    simulation.step(120)
    before, speed = simulation.joint_positions()[0], simulation.joint_states()[1][0]
    assert speed > 0.5
    simulation.hold()
    simulation.step(120)
    stopped = simulation.joint_positions()[0]
    assert before < stopped < before + speed**2 / ACCELERATION_RAD_S2[0] + 0.02
    simulation.step(120)
    assert simulation.joint_positions()[0] == pytest.approx(stopped, abs=1e-3)


@pytest.mark.parametrize(
    ("names", "position", "duration_s", "named"),
    [
        (["fr3_joint9"], [0.0], 0.1, "fr3_joint9"),
        (["fr3_finger_joint2"], [0.0], 0.1, "fr3_finger_joint2"),
        (["fr3_joint1", "fr3_joint1"], [0.0, 0.0], 0.1, "only once"),
        ([], [], 0.1, "at least one"),
        (["fr3_joint1"], [0.0, 1.0], 0.1, "shape"),
        (["fr3_joint1", "fr3_joint2"], [0.0, np.nan], 0.1, "fr3_joint2"),
        (["fr3_joint1"], [np.inf], 0.1, "fr3_joint1"),
        (["fr3_joint1"], [0.0], 0.0, "duration_s"),
        (["fr3_joint1"], [0.0], float("nan"), "duration_s"),
    ],
)
def test_senseless_command_is_refused_and_moves_nothing(
    simulation: ArmSimulation,
    names: list[str],
    position: list[float],
    duration_s: float,
    named: str,
) -> None:
    with pytest.raises(InvalidInputError, match=named):
        simulation.set_target(names, position, duration_s)
    simulation.step(24)
    np.testing.assert_allclose(simulation.joint_positions()[:7], HOME_RAD, atol=1e-3)


def test_closed_simulation_says_so() -> None:
    simulation = ArmSimulation(0)
    simulation.close()
    with pytest.raises(StateError, match="not open"):
        simulation.step()


def test_unknown_camera_is_refused_with_the_choices(simulation: ArmSimulation) -> None:
    with pytest.raises(InvalidInputError, match="front, wrist"):
        simulation.render("left")


def test_same_calls_give_the_same_motion(engine: Engine) -> None:
    def run() -> np.ndarray:
        with ArmSimulation(2, engine=engine) as simulation:
            simulation.set_target(["fr3_joint1", FINGER_JOINT], [0.4, 0.0], 0.3)
            simulation.step(200)
            return np.concatenate(
                [simulation.joint_positions(), *(c.position_m for c in simulation.cubes().values())]
            )

    np.testing.assert_array_equal(run(), run())
