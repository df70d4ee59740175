"""The physics really grasps: a scripted pick with the simulator's ground truth (not available to
policies).
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_robot_fr3.simulation import STEP_S, ArmSimulation
from rn_simulation.engine import Engine


def solve(target: pin.SE3, seed_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Joint positions (7,) for a TCP pose `target`: damped least squares from `seed_rad`."""
    model = pin.buildReducedModel(pin.buildModelFromXML(profile().urdf), [8, 9], np.zeros(9))
    data, frame, q = model.createData(), model.getFrameId(profile().tcp_link), seed_rad.copy()
    for _ in range(200):
        pin.framesForwardKinematics(model, data, q)
        error = pin.log6(data.oMf[frame].actInv(target)).vector
        if np.linalg.norm(error) < 1e-6:
            return q
        jacobian = pin.computeFrameJacobian(model, data, q, frame)
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-6 * np.eye(6), error)
        q = np.clip(q + 0.7 * step, model.lowerPositionLimit, model.upperPositionLimit)
    raise AssertionError(f"no posture reaches {target}")


@pytest.mark.parametrize(("seed", "colour"), [(0, "red"), (1, "blue")])
def test_scripted_pick_lifts_the_cube_and_only_that(engine: Engine, seed: int, colour: str) -> None:
    with ArmSimulation(seed, engine=engine) as simulation:
        cube, q = simulation.cubes()[colour], np.array(HOME_RAD)
        x, y = cube.position_m[:2]
        yaw = 2.0 * np.arctan2(cube.quaternion_xyzw[2], cube.quaternion_xyzw[3])
        down = np.array([[np.cos(yaw), np.sin(yaw), 0], [np.sin(yaw), -np.cos(yaw), 0], [0, 0, -1]])

        def move(z: float, duration_s: float) -> None:
            nonlocal q
            q = solve(pin.SE3(down, np.array([x, y, z])), q)
            simulation.set_target(ARM_JOINTS, q, duration_s)
            simulation.step(round((duration_s + 0.3) / STEP_S))
            # The motors hold the arm's weight within a millimetre.
            np.testing.assert_allclose(simulation.tcp_pose().position_m, [x, y, z], atol=1e-3)

        move(0.15, 1.2)
        move(0.02, 0.8)
        simulation.set_target([FINGER_JOINT], [0.0], 0.5)
        simulation.step(200)
        # The fingers stop at the cube, so the measured opening is its edge length.
        assert simulation.joint_positions()[7:].sum() == pytest.approx(cube.edge_m, abs=1e-3)
        move(0.25, 1.0)
        simulation.step(round(1.2 / STEP_S))
        lifted = simulation.cubes()
        assert lifted[colour].lifted_m > 0.2
        assert lifted[colour].held_s >= 1.0
        assert all(
            other.lifted_m < 0.01 and other.held_s == 0.0
            for name, other in lifted.items()
            if name != colour
        )

        simulation.hold()
        simulation.step(60)
        assert simulation.cubes()[colour].lifted_m > 0.2
        simulation.set_target([FINGER_JOINT], [0.04], 0.2)
        simulation.step(240)
        assert simulation.cubes()[colour].held_s == 0.0


def test_a_grip_that_is_commanded_again_and_again_keeps_its_force(engine: Engine) -> None:
    """Control repeats the opening with every action: the setpoint stays inside the held object."""
    with ArmSimulation(0, engine=engine) as simulation:
        simulation.set_target([FINGER_JOINT], [0.0], 0.3)
        simulation.step(200)
        for _ in range(10):
            simulation.set_target([FINGER_JOINT], [0.0], 0.1)
            assert simulation._setpoint.position[-1] < 1e-3
        simulation.set_target([FINGER_JOINT], [0.04], 0.5)
        simulation.step(200)
        assert simulation.gripper_open() > 0.97


def test_a_held_cube_is_kept_by_the_commanded_opening(engine: Engine) -> None:
    """Actions keep the opening: 2 cm up in ten actions, as move_ee does, with the cube in the
    hand.
    """
    with ArmSimulation(0, engine=engine) as simulation:
        cube, q = simulation.cubes()["red"], np.array(HOME_RAD)
        x, y = cube.position_m[:2]
        yaw = 2.0 * np.arctan2(cube.quaternion_xyzw[2], cube.quaternion_xyzw[3])
        down = np.array([[np.cos(yaw), np.sin(yaw), 0], [np.sin(yaw), -np.cos(yaw), 0], [0, 0, -1]])
        for z, finger_m in ((0.15, 0.04), (0.02, 0.04), (0.02, 0.0), (0.20, 0.0)):
            q = solve(pin.SE3(down, np.array([x, y, z])), q)
            simulation.set_target([*ARM_JOINTS, FINGER_JOINT], [*q, finger_m], 1.0)
            simulation.step(round(1.3 / STEP_S))
        for number in range(1, 11):
            q = solve(pin.SE3(down, np.array([x, y, 0.20 + 0.002 * number])), q)
            simulation.set_target([*ARM_JOINTS, FINGER_JOINT], [*q, 0.0], 0.1)
            simulation.step(round(0.1 / STEP_S))
        simulation.step(round(2.0 / STEP_S))
        assert simulation.cubes()["red"].lifted_m > 0.19
        assert simulation.cubes()["red"].held_s > 2.0
