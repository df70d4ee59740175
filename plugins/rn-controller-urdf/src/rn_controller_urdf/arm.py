"""One arm of the robot: forward kinematics of measured joints, and joints for a TCP target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pinocchio
from numpy.typing import NDArray

from rn_controller_urdf.ik import InverseKinematics, Solution
from rn_controller_urdf.model import ArmModel, build_arm_model
from rn_controller_urdf.options import UrdfControllerOptions
from rn_controller_urdf.refusals import (
    BAD_STATE,
    UNKNOWN_JOINT,
    check_reach,
    check_solution,
    check_workspace,
    joint_bounds,
)
from roboneuron import ArmProfile, Hold, JointSample, Pose, RobotProfile, UnsafeError

F64 = NDArray[np.float64]

_STOP_FRACTION = 0.1
"""Fraction of the tolerances at which the solver stops, so that small actions still move
the arm.
"""


class ArmKinematics:
    """Kinematics and bounds of one arm; positions are float64 (n,) in the order of its chain.

    Poses are TCP poses in the robot's base frame. `view` and `pose` use separate scratch memory, so
    that they may run in parallel with `solve`.

    Attributes:
        name: as in the profile; "" for the only arm.
        gripper: None without one.
        model: chain and limits.
        bounds: bounds of each joint in one step.
        span: differences of its joints.
        solver: the inverse kinematics.
    """

    def __init__(
        self, options: UrdfControllerOptions, profile: RobotProfile, arm: ArmProfile
    ) -> None:
        """Build the chain. Raises ConfigurationError if URDF, links, joints or limits do not form
        an arm.
        """
        self.name, self.gripper = arm.name, arm.gripper
        self.model: ArmModel = build_arm_model(profile.of_arm(arm))
        self.bounds = joint_bounds(options, self.model)
        self.span = profile.kinds.span(self.model.joints)
        self.solver = InverseKinematics(self.model)
        self._viewer = InverseKinematics(self.model)
        self._options = options
        self._workspace = profile.workspace
        self._order: tuple[tuple[str, ...], list[int]] = ((), [])

    def pose(self, joints: JointSample) -> Pose:
        """TCP pose, stamped as the joints are. Raises UnsafeError for missing or non-finite
        joints.
        """
        return self._pose(self._viewed(joints), joints.stamp_ns)

    def view(self, joints: JointSample) -> tuple[Pose, float]:
        """TCP pose and smallest singular value. Raises as `pose`."""
        position = self._viewed(joints)
        singular = self._viewer.smallest_singular_value(
            position, track_rotation=self._options.track == "pose"
        )
        return self._pose(position, joints.stamp_ns), singular

    def _pose(self, position: F64, stamp_ns: int) -> Pose:
        pose = self._viewer.place(position)
        return Pose(
            position_m=np.array(pose.translation),
            quaternion_xyzw=self._viewer.quaternion(pose),
            stamp_ns=stamp_ns,
        )

    def _viewed(self, joints: JointSample) -> F64:
        position = self.position(joints)
        if isinstance(position, Hold):
            raise UnsafeError(position.reason)
        if not all(map(math.isfinite, position.tolist())):
            raise UnsafeError(
                f"A measured joint of {list(self.model.joints)} is not finite: {position.tolist()}."
            )
        return position

    def position(self, joints: JointSample) -> F64 | Hold:
        """Measured arm joints, or the reason why they are missing."""
        names, indices = self._order
        if names != joints.names:
            missing = [name for name in self.model.joints if name not in joints.names]
            if missing:
                return Hold(
                    code=UNKNOWN_JOINT,
                    reason=f"The measured joints {list(joints.names)} lack {missing} of the arm.",
                )
            indices = [joints.names.index(name) for name in self.model.joints]
            self._order = (joints.names, indices)
        values = np.asarray(joints.position, dtype=np.float64)
        if values.shape != (len(joints.names),):
            return Hold(
                code=BAD_STATE,
                reason=f"{len(joints.names)} joints are named but positions have shape "
                f"{values.shape}.",
            )
        position: F64 = values[indices]
        return position

    def solve(self, start: F64, target: pinocchio.SE3) -> Solution:
        """Joints near `start` for a pose of the TCP, or the best intermediate solution."""
        options = self._options
        return self.solver.solve(
            np.minimum(np.maximum(start, self.model.lower), self.model.upper),
            target,
            tolerance_m=options.position_tolerance_m * _STOP_FRACTION,
            tolerance_rad=options.rotation_tolerance_rad * _STOP_FRACTION,
            max_iterations=options.max_iterations,
            track_rotation=options.track == "pose",
        )

    def solve_pose(self, values: Mapping[str, float], start: F64) -> Solution | Hold:
        """Joints for an absolute pose of the TCP, x y z [m] and qx qy qz qw, seeded with the
        initial joints.
        """
        here = self.solver.place(start)
        target = pinocchio.SE3(
            pinocchio.Quaternion(*(values[f"q{name}"] for name in "wxyz")).normalized().matrix(),
            np.array([values[name] for name in "xyz"]),
        )
        turn = float(np.linalg.norm(pinocchio.log3(here.rotation.T @ target.rotation)))
        distance = math.dist(here.translation.tolist(), target.translation.tolist())
        refusal = check_reach(distance, turn, self._options) or self.check_target(
            here.translation, target.translation
        )
        if refusal is not None:
            return refusal
        solution = self.solve(start, target)
        return check_solution(solution, self._options) or solution

    def check_target(self, here_m: F64, target_m: F64) -> Hold | None:
        """Return OUTSIDE_WORKSPACE for a forbidden target (3,) [m]."""
        return check_workspace(here_m, target_m, self._workspace)

    def told(self, refusal: Hold) -> Hold:
        """Return the refusal with the name of the arm, if there are several."""
        return replace(refusal, reason=f"{self.name}: {refusal.reason}") if self.name else refusal
