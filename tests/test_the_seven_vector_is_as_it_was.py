"""Actions of the default space: for one seed the bytes on the topic equal those of the version
before control spaces, and control's joint commands only change with the limiter
(data/seven-vector.npz).

    python tests/test_the_seven_vector_is_as_it_was.py OUT.npz

writes the numbers. The bytes are those of bf5b77ad; the commands were regenerated when the limiter
began to brake in time for a goal that jumps.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

from rn_controller_urdf.controller import UrdfController
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron.config import LimitsConfig
from roboneuron.contract import Action, ActionChunk, JointCommand, JointSample
from roboneuron.gate.motion import MotionLimiter, motion_rules
from roboneuron.ros.messages import to_action_message, to_joint_trajectory

DATA = Path(__file__).parent / "data" / "seven-vector.npz"
ROWS, STEP_S, LASTS_S = 60, 0.05, 0.08
SIZES = np.array([0.04, 0.04, 0.04, 0.15, 0.15, 0.15])
"""Standard deviations of a row [m, rad]; a limit acts occasionally."""
PADDING = slice(26, 28)
"""Bytes after the label, which the serializer leaves unchanged."""


def rows() -> np.ndarray:
    """Actions of one seed (n, 7)."""
    rng = np.random.default_rng(20)
    moves = rng.normal(size=(ROWS, 6)) * SIZES
    return np.column_stack([moves, rng.uniform(size=ROWS)])


def produce(chunk: ActionChunk) -> tuple[np.ndarray, np.ndarray]:
    """Bytes of the action messages (n, k), and positions and durations of each command; NaN where
    the arm holds.
    """
    robot = profile()
    controller = UrdfController(None, robot)
    controller.load()
    limiter = MotionLimiter(
        motion_rules(LimitsConfig(), robot), robot, controller.forward, controller.inspect
    )
    messages, commands = [], []
    position, now_s = np.array(HOME_RAD), 100.0
    for row in chunk.actions:
        raw = np.frombuffer(serialize_message(to_action_message(row)), dtype=np.uint8).copy()
        raw[PADDING] = 0
        messages.append(raw)
        now_s += STEP_S
        joints = JointSample(names=robot.arm_joints, position=position)
        sent = controller.compute(Action.from_vector(row), joints, LASTS_S)
        if isinstance(sent, JointCommand):
            sent = limiter.limit(sent, joints, now_s).command
        if not isinstance(sent, JointCommand):
            limiter.rest(joints, now_s)
            commands.append(np.full(len(HOME_RAD) + 2, np.nan))
            continue
        (point,) = to_joint_trajectory(sent).points
        lasts_s = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
        commands.append(np.array([*point.positions, lasts_s]))
        arm = np.array(point.positions)[[sent.names.index(name) for name in robot.arm_joints]]
        position = position + (arm - position) * min(1.0, STEP_S / lasts_s)
    return np.array(messages), np.array(commands)


def test_bytes_and_commands_of_a_seed_are_those_that_were_written_down() -> None:
    with np.load(DATA) as expected:
        messages, commands = expected["messages"], expected["commands"]
    found, made = produce(ActionChunk(actions=rows(), step_s=STEP_S))
    np.testing.assert_array_equal(found, messages)
    # other processors round the sums of the kinematics differently, which accumulates over the rows
    np.testing.assert_allclose(made, commands, rtol=0, atol=1e-9)
    assert 10 < np.isnan(commands[:, 0]).sum() < ROWS - 10


if __name__ == "__main__":
    found, made = produce(ActionChunk(actions=rows(), step_s=STEP_S))
    np.savez_compressed(sys.argv[1], messages=found, commands=made)
