"""Predicted state for backends trained on it: the measured state after the rows still to be
played.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roboneuron.contract import (
    EE_DELTA,
    GRIPPER,
    Action,
    ArmState,
    ControlSpace,
    JointSample,
    Observation,
    Pose,
    apply_delta,
)
from roboneuron.contract.arrays import F64


def roll_forward(
    observation: Observation,
    rows: F64,
    done_share: float = 0.0,
    space: ControlSpace = EE_DELTA,
    step_s: float = 0.0,
) -> Observation:
    """Return the observation with the state after `rows`.

    Only quantities that the space moves are predicted: TCP poses by TCP deltas and poses, joints by
    joint positions and velocities, and the grippers, for each arm that it moves. The rest stays as
    measured, since neither joints can be computed from TCP deltas nor the TCP from joints here.
    Commands overestimate the motion of an arm that lags behind.

    Args:
        observation: measured.
        rows: float64 (N, n), N >= 1, oldest first, contract units.
        done_share: fraction of the first row executed at the measurement, 0 .. 1; it scales the
            rotation vector of a TCP delta.
        space: space of the rows.
        step_s: their period [s].

    Source: VLASH, arXiv 2512.01031, for absolute actions; extended here to every space.
    """
    left = np.ones(len(rows))
    left[0] -= done_share
    # the state without an arm's name is that of the robot's first
    first = next(iter(observation.arms), "")
    opening, pose = observation.gripper_open, observation.ee_pose
    if opening is not None:
        opening = _rolled_opening(opening, rows, space, first)
    if pose is not None:
        pose = _rolled_pose(pose, rows, left, space, first)
    arms = {
        name: ArmState(
            ee_pose=_rolled_pose(arm.ee_pose, rows, left, space, name),
            gripper_open=None
            if arm.gripper_open is None
            else _rolled_opening(arm.gripper_open, rows, space, name),
        )
        for name, arm in observation.arms.items()
    }
    joints = observation.joints
    if joints is not None and space.kind.startswith("joint"):
        joints = _rolled_joints(joints, rows, left * step_s, space)
    return replace(observation, ee_pose=pose, joints=joints, gripper_open=opening, arms=arms)


def _rolled_opening(opening: float, rows: F64, space: ControlSpace, arm: str) -> float:
    for column, channel in enumerate(space.channels):
        if channel.name == GRIPPER and channel.arm == arm:
            return float(rows[-1, column])
    return opening


def _rolled_pose(pose: Pose, rows: F64, left: F64, space: ControlSpace, arm: str) -> Pose:
    if space.kind == "ee_pose":
        end = {
            channel.name: value
            for channel, value in zip(space.channels, rows[-1].tolist(), strict=True)
            if channel.arm == arm
        }
        if not end:
            return pose
        quaternion = np.array([end[f"q{name}"] for name in "xyzw"])
        return Pose(
            position_m=np.array([end[name] for name in "xyz"]),
            quaternion_xyzw=quaternion / np.linalg.norm(quaternion),
            stamp_ns=pose.stamp_ns,
        )
    if space.kind != "ee_delta":
        return pose
    for row, share in zip(rows, left, strict=True):
        pose = apply_delta(
            pose,
            Action(translation_m=row[:3] * share, rotation_rad=row[3:6] * share, gripper_open=1.0),
        )
    return pose


def _rolled_joints(
    joints: JointSample, rows: F64, times_s: F64, space: ControlSpace
) -> JointSample:
    position = np.array(joints.position)
    for column, channel in enumerate(space.channels):
        if channel.name in joints.names:
            joint = joints.names.index(channel.name)
            if space.kind == "joint_velocity":
                position[joint] += float(rows[:, column] @ times_s)
            else:
                position[joint] = rows[-1, column]
    return replace(joints, position=position)
