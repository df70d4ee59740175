"""A controller for the gantry, whose joints are its TCP pose, so the inverse kinematics is
trivial.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rn_testing.fakes.robot import HINGES, SLIDES
from roboneuron import (
    Action,
    ConfigurationError,
    ControllerSpec,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    RobotProfile,
    StateError,
    UnsafeError,
    apply_delta,
    matrix_from_quaternion,
    matrix_from_rotvec,
    quaternion_from_matrix,
    robot_space,
)

F64 = NDArray[np.float64]

MAX_STEP = 0.3
"""Largest change of a joint per action [m or rad]."""


def _joints_at(pose: Pose) -> F64:
    """Joint positions of the gantry for a TCP pose."""
    m = matrix_from_quaternion(pose.quaternion_xyzw)
    hinges = (
        math.atan2(m[1, 0], m[0, 0]),
        math.asin(np.clip(-m[2, 0], -1, 1)),
        math.atan2(m[2, 1], m[2, 2]),
    )
    return np.concatenate([pose.position_m, hinges])


class GantryController:
    """Follows the protocols `Controller` and `SpaceController`, for profiles with the gantry's
    joints.
    """

    def __init__(self, config: None, profile: RobotProfile) -> None:
        self._profile = profile
        self._loaded = False

    def load(self) -> None:
        """Raises ConfigurationError for robots other than a gantry."""
        links = tuple(
            f'<link name="{name}"' for name in (self._profile.base_link, self._profile.tcp_link)
        )
        if self._profile.arm_joints != (*SLIDES, *HINGES) or any(
            link not in self._profile.urdf for link in links
        ):
            raise ConfigurationError(f"Robot {self._profile.name!r} is no gantry.")
        self._loaded = True

    def _measured(self, joints: JointSample) -> F64:
        if not self._loaded:
            raise StateError("The controller is not loaded; call load() first.")
        values = dict(zip(joints.names, joints.position.tolist(), strict=True))
        absent = [n for n in self._profile.arm_joints if not math.isfinite(values.get(n, math.nan))]
        if absent:
            raise UnsafeError(f"Joint {absent[0]!r} is missing or not finite.")
        return np.array([values[n] for n in self._profile.arm_joints])

    def forward(self, joints: JointSample) -> Pose:
        """The slides give the position, the hinges yaw, pitch and roll. Raises UnsafeError for
        missing joints.
        """
        q = self._measured(joints)
        yaw, pitch, roll = (
            matrix_from_rotvec(axis * q[3 + i]) for i, axis in enumerate(np.eye(3)[::-1])
        )
        rotation = quaternion_from_matrix(yaw @ pitch @ roll)
        return Pose(position_m=q[:3].copy(), quaternion_xyzw=rotation, stamp_ns=joints.stamp_ns)

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        """Joints of the target pose; holds for invalid numbers, large steps and positions outside
        the limits.

        A step above a joint's velocity limit gets more time.
        """
        try:
            measured = self._measured(joints)
        except UnsafeError as error:
            return Hold(code="bad_state", reason=str(error))
        if not np.isfinite(action.to_vector()).all() or not (math.isfinite(step_s) and step_s > 0):
            return Hold(
                code="bad_action",
                reason=f"Action or step_s ({step_s}) is not finite, or there is no time.",
            )
        q = _joints_at(apply_delta(self.forward(joints), action))
        return self._command(q, measured, action.gripper_open, step_s)

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Joints of a row, or of its pose; holds as `compute` does, and for channels of another
        robot.
        """
        try:
            measured = self._measured(joints)
        except UnsafeError as error:
            return Hold(code="bad_state", reason=str(error))
        own = robot_space(space.kind, self._profile)
        if space.kind not in FAKE_CONTROLLER.spaces or space.keys != own.keys:
            return Hold(code="bad_action", reason=f"{space.label!r} is not executed.")
        if not np.isfinite(row).all() or not (math.isfinite(step_s) and step_s > 0):
            return Hold(
                code="bad_action",
                reason=f"Row or step_s ({step_s}) is not finite, or there is no time.",
            )
        q = row[:6]
        if space.kind == "ee_pose":
            q = _joints_at(Pose(position_m=row[:3], quaternion_xyzw=row[3:7]))
        elif space.kind == "joint_velocity":
            q = measured + row[:6] * step_s
        return self._command(q, measured, float(row[-1]), step_s)

    def _command(
        self, q: F64, measured: F64, gripper_open: float, step_s: float
    ) -> JointCommand | Hold:
        step = float(np.abs(q - measured).max())
        limits, gripper = self._profile.limits, self._profile.gripper
        assert limits is not None
        if step > MAX_STEP:
            return Hold(
                code="joint_jump",
                reason=f"A joint would move by {step:.3f}, the limit is {MAX_STEP}.",
            )
        if (q < limits.lower).any() or (q > limits.upper).any():
            return Hold(code="joint_limit", reason="The target is outside the joint limits.")
        duration_s = max(step_s, float((np.abs(q - measured) / limits.velocity).max()))
        if gripper is None:
            return JointCommand(names=self._profile.arm_joints, position=q, duration_s=duration_s)
        finger = gripper.to_position(gripper_open)
        names = (*self._profile.arm_joints, gripper.joint)
        return JointCommand(names=names, position=np.append(q, finger), duration_s=duration_s)

    def close(self) -> None:
        """Unload."""
        self._loaded = False


FAKE_CONTROLLER = ControllerSpec(
    name="gantry",
    summary="Reads the gantry's joints off the target pose.",
    target="rn_testing.fakes.controller:GantryController",
    spaces=("ee_delta", "ee_pose", "joint_position", "joint_velocity"),
)
"""Descriptor of the fake controller."""
