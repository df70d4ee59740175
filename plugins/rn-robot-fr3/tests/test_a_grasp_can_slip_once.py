"""The simulated gripper holds a cube where it is, opens once, at the chosen moment, and grasps
again afterwards.
"""

from __future__ import annotations

import numpy as np
import pytest
from test_gripper_grasps_and_lifts_a_cube import solve

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_simulation.engine import Engine
from rn_simulation.slip import SWITCH, slips_after_s
from roboneuron import ConfigurationError

AFTER_S = 1.0


def _pick(simulation: ArmSimulation, colour: str) -> None:
    import pinocchio as pin

    cube, q = simulation.cubes()[colour], np.array(HOME_RAD)
    x, y = cube.position_m[:2]
    yaw = 2.0 * np.arctan2(cube.quaternion_xyzw[2], cube.quaternion_xyzw[3])
    down = np.array([[np.cos(yaw), np.sin(yaw), 0], [np.sin(yaw), -np.cos(yaw), 0], [0, 0, -1]])
    simulation.set_target([FINGER_JOINT], [0.04], 0.5)
    for z_m in (0.15, 0.02):
        q = solve(pin.SE3(down, np.array([x, y, z_m])), q)
        simulation.set_target(ARM_JOINTS, q, 1.2)
        simulation.step(round(1.5 / STEP_S))
    simulation.set_target([FINGER_JOINT], [0.0], 0.5)
    simulation.step(200)
    q = solve(pin.SE3(down, np.array([x, y, 0.2])), q)
    simulation.set_target(ARM_JOINTS, q, 1.0)
    simulation.step(round(1.2 / STEP_S))


def test_the_cube_falls_once_and_can_be_picked_up_again(engine: Engine) -> None:
    with ArmSimulation(0, engine=engine) as simulation:
        simulation.let_slip(AFTER_S)
        _pick(simulation, "red")
        assert simulation.cubes()["red"].lifted_m > 0.15
        simulation.step(round((AFTER_S + 0.8) / STEP_S))
        assert abs(simulation.cubes()["red"].lifted_m) < 0.01
        assert simulation.gripper_open() < 0.02  # it has closed on nothing, which agents can detect
        _pick(simulation, "red")
        simulation.step(round((AFTER_S + 1.0) / STEP_S))
        assert simulation.cubes()["red"].held_s > AFTER_S + 0.4


@pytest.mark.exhaustive
def test_a_held_cube_does_not_creep_in_the_hand(engine: Engine) -> None:
    with ArmSimulation(0, engine=engine) as simulation:
        _pick(simulation, "red")
        simulation.step(round(1.0 / STEP_S))
        before = simulation.cubes()["red"]
        simulation.step(round(20.0 / STEP_S))
        after = simulation.cubes()["red"]
    assert np.linalg.norm(after.position_m - before.position_m) < 5e-4
    assert abs(after.quaternion_xyzw @ before.quaternion_xyzw) > np.cos(np.radians(0.5) / 2)


def test_without_the_switch_nothing_slips(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(SWITCH, raising=False)
    assert slips_after_s() is None
    monkeypatch.setenv(SWITCH, "2.5")
    assert slips_after_s() == 2.5


@pytest.mark.parametrize("text", ["soon", "0", "-1", "nan", "inf"])
def test_a_switch_that_is_no_time_is_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(SWITCH, text)
    with pytest.raises(ConfigurationError, match=SWITCH):
        slips_after_s()
