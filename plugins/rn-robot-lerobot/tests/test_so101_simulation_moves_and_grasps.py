"""The simulated SO-101: motion within its limits, a grasp that lifts, correct cameras."""

from __future__ import annotations

import json

import numpy as np
import pinocchio as pin
import pytest

from rn_robot_lerobot.arm import ARM_JOINTS, JOINTS, SO101
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.driver import SimulatedSo101Driver
from rn_robot_lerobot.options import SimulatedSo101Options
from rn_robot_lerobot.profile import so101_profile
from rn_robot_lerobot.scene import LIFTED_M, REGION, random_cubes
from rn_robot_lerobot.simulation import CELL, So101Simulation
from rn_simulation.arm_cell import STEP_S
from rn_simulation.scene_state import TOPIC, from_message
from rn_testing.fakes import MemoryTopics
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError, InvalidInputError, JointCommand

START = CELL.start


def joints_above(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> np.ndarray:
    """Arm joints whose TCP points down at a position, with the jaws at a yaw."""
    model = pin.buildModelFromXML(so101_profile().urdf)
    data, frame = model.createData(), model.getFrameId(so101_profile().tcp_link)
    down = pin.rpy.rpyToMatrix(np.pi, 0.0, yaw_rad)
    target, q = pin.SE3(down, np.array([x_m, y_m, z_m])), pin.neutral(model)
    for name, angle in zip(ARM_JOINTS, START, strict=False):
        q[model.joints[model.getJointId(name)].idx_q] = angle
    for _ in range(200):
        pin.framesForwardKinematics(model, data, q)
        error = pin.log6(data.oMf[frame].actInv(target)).vector
        jacobian = pin.computeFrameJacobian(model, data, q, frame)
        q = q + 0.5 * np.linalg.lstsq(jacobian, error, rcond=1e-3)[0]
    assert np.linalg.norm(error[:3]) < 1e-3
    return np.array([q[model.joints[model.getJointId(name)].idx_q] for name in ARM_JOINTS])


def go(simulation: So101Simulation, arm: np.ndarray, jaw_rad: float, seconds: float) -> None:
    simulation.set_target(JOINTS, [*arm, jaw_rad], seconds)
    simulation.step(round((seconds + 0.4) / STEP_S))


@pytest.mark.parametrize("seed", [0, 3, 11])
def test_a_cube_is_grasped_and_lifted(seed: int) -> None:
    with So101Simulation(seed, colours=("red",)) as simulation:
        cube = simulation.scene[0]
        yaw = cube.yaw_rad + np.pi  # the jaws' faces are along x of the TCP
        high = joints_above(cube.x_m, cube.y_m, 0.06, yaw)
        low = joints_above(cube.x_m, cube.y_m, 0.014, yaw)
        for arm, jaw in ((high, START[-1]), (low, START[-1]), (low, SO101.jaw_closed_rad)):
            go(simulation, arm, jaw, 1.5)
        grasped = simulation.gripper_open()
        assert 0.05 < grasped < 0.3
        go(simulation, high, SO101.jaw_closed_rad, 1.5)
        simulation.step(240)
        lifted = simulation.cubes()["red"]
        assert lifted.lifted_m > LIFTED_M
        assert lifted.held_s > 1.0


def test_a_gripper_that_closes_on_nothing_is_closed() -> None:
    with So101Simulation(colours=("red",)) as simulation:
        go(simulation, START[:5], SO101.jaw_closed_rad, 1.0)
        assert simulation.gripper_open() < 0.02


def test_the_arm_follows_and_brakes_within_its_acceleration() -> None:
    with So101Simulation() as simulation:
        simulation.set_target(ARM_JOINTS, np.array([1.0, 0.3, -0.4, 1.2, 0.5]), 0.2)
        velocities = []
        for step in range(300):
            if step == 60:
                simulation.hold()
            simulation.step()
            velocities.append(simulation.joint_states()[1][:5].copy())
        assert np.abs(velocities[-1]).max() < 1e-3
        at_hold = np.abs(velocities[59]).max()
        stopped = next(i for i, v in enumerate(velocities[60:]) if np.abs(v).max() < 0.02)
        # braking time of the limits, plus the lag of the servo
        assert stopped * STEP_S < at_hold / SO101.acceleration_rad_s2 + 0.25


def test_commands_beyond_the_limits_are_clamped_and_nonsense_is_refused() -> None:
    with So101Simulation() as simulation:
        sent = simulation.set_target(["elbow_flex"], [9.0], 0.1)
        assert sent.position.tolist() == [1.69]
        assert sent.duration_s > 0.5
        with pytest.raises(InvalidInputError, match="elbow"):
            simulation.set_target(["elbow"], [0.0], 0.1)


def test_what_a_camera_shows_is_where_its_calibration_says() -> None:
    with So101Simulation(1, colours=("red",)) as simulation:
        simulation.step(60)
        position = np.array([*simulation.cubes()["red"].position_m, 1.0])
        for camera in cameras():
            calibration = camera.calibration(224, 224)
            mount = np.eye(4) if camera.mount == "base" else simulation.world.T_base_tcp()
            point = np.linalg.inv(mount @ calibration.T_mount_camera) @ position
            u, v, w = calibration.intrinsics @ point[:3]
            image = simulation.render(camera.name).astype(int)
            red = (image[:, :, 0] > 90) & (image[:, :, 1:].max(axis=2) < 60)
            if not 20 < u / w < 204 or not 20 < v / w < 204:
                assert camera.name == "wrist"  # the cube is outside its view, or cut by its edge
                continue
            rows, columns = np.nonzero(red)
            # the centroid of a cube's visible part is within half of it
            size_px = np.sqrt(red.sum())
            assert abs(columns.mean() - u / w) < size_px / 2
            assert abs(rows.mean() - v / w) < size_px / 2


def test_scenes_lie_in_the_region_apart_from_each_other() -> None:
    for seed in range(30):
        cubes = random_cubes(seed, ("red", "green", "blue", "yellow"))
        places = np.array([(cube.x_m, cube.y_m) for cube in cubes])
        assert (places >= (REGION.x_m[0], REGION.y_m[0])).all()
        assert (places <= (REGION.x_m[1], REGION.y_m[1])).all()
        apart = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(len(cubes))
        assert apart.min() >= REGION.spacing_m
    assert random_cubes(3) == random_cubes(3)


def test_the_driver_tells_its_state_and_keeps_a_grasp_when_it_holds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("ROBONEURON_SIMULATOR_TRUTH", "on")
    topics = MemoryTopics()
    driver = SimulatedSo101Driver(SimulatedSo101Options(seed=5), so101_profile(), topics)
    driver.open()
    try:
        state = driver.read()
        assert state.joints.names == JOINTS
        assert set(json.loads(state.detail["cubes"])) == {"red", "green", "blue"}
        command = JointCommand(
            names=("shoulder_pan", "gripper"), position=np.array([0.4, 0.0]), duration_s=0.4
        )
        assert driver.send(command).names == command.names
        driver.hold()
        assert wait_until(lambda: (driver.read().gripper_open or 0.0) < 0.12)
        assert wait_until(lambda: bool(topics.published(TOPIC)))
        told = from_message(topics.published(TOPIC)[-1], {SO101.name: len(JOINTS)})
        assert [name for name, _ in told.cubes] == ["red", "green", "blue"]
    finally:
        driver.close()


def test_another_robots_profile_is_refused() -> None:
    from dataclasses import replace

    other = replace(so101_profile(), arm_joints=("a", "b"))
    driver = SimulatedSo101Driver(None, other, MemoryTopics())
    with pytest.raises(ConfigurationError, match="the profile 'so101' has a, b"):
        driver.open()
