"""The controller "urdf": a row of any control space and measured joints to a joint command, or a
refusal with the reason.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pinocchio
from numpy.typing import NDArray

from rn_controller_urdf.collision import CollisionModel
from rn_controller_urdf.ik import InverseKinematics, Solution
from rn_controller_urdf.model import ArmModel, build_arm_model
from rn_controller_urdf.options import UrdfControllerOptions
from rn_controller_urdf.refusals import (
    BAD_STATE,
    UNKNOWN_JOINT,
    JointBounds,
    check_action,
    check_reach,
    check_solution,
    check_start,
    check_step,
    check_time,
    check_workspace,
    joint_bounds,
    shortest_duration_s,
)
from roboneuron import (
    GRIPPER,
    Action,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
    StateError,
    UnsafeError,
)

F64 = NDArray[np.float64]

_STOP_FRACTION = 0.1
"""The solver iterates to this share of the tolerances, so that small actions still move the arm."""


def _not_loaded() -> StateError:
    return StateError(
        "The controller 'urdf' was used before it was loaded.", hint="Call load() first."
    )


def _pose(viewer: InverseKinematics, position: F64, stamp_ns: int) -> Pose:
    pose = viewer.place(position)
    return Pose(
        position_m=np.array(pose.translation),
        quaternion_xyzw=viewer.quaternion(pose),
        stamp_ns=stamp_ns,
    )


class UrdfController:
    """Differential inverse kinematics on the URDF of `profile`; seeded with the measured joints,
    without memory.

    A command whose joints would need more than their velocity limits over `step_s` is given more
    time (`JointCommand.duration_s` >= step_s), never more speed. Not thread-safe; `forward` may run
    beside `compute`.
    """

    def __init__(self, config: UrdfControllerOptions | None, profile: RobotProfile) -> None:
        self._options = config or UrdfControllerOptions()
        self._profile = profile
        self._model: ArmModel | None = None
        self._solver: InverseKinematics | None = None
        self._viewer: InverseKinematics | None = None
        self._collision: CollisionModel | None = None
        self._bounds: tuple[JointBounds, ...] | None = None
        self._order: tuple[tuple[str, ...], list[int]] = ((), [])

    def load(self) -> None:
        """Parse the URDF and build the arm.

        Raises:
            ConfigurationError: the profile's URDF, links, joints or limits do not make an arm.
        """
        self._model = build_arm_model(self._profile)
        self._bounds = joint_bounds(self._options, self._model)
        self._solver = InverseKinematics(self._model)
        self._viewer = InverseKinematics(self._model)
        if self._profile.collision is not None:
            self._collision = CollisionModel(self._profile, self._profile.collision)

    def forward(self, joints: JointSample) -> Pose:
        """TCP pose in the base frame, stamped as the joints are.

        Raises:
            UnsafeError: an arm joint is missing or not finite.
            StateError: called before `load`.
        """
        viewer, position = self._viewed(joints)
        return _pose(viewer, position, joints.stamp_ns)

    def inspect(self, joints: JointSample) -> Posture:
        """TCP pose, smallest singular value and, where the profile asks, what is too near. Raises
        as `forward`.
        """
        viewer, position = self._viewed(joints)
        return Posture(
            pose=_pose(viewer, position, joints.stamp_ns),
            smallest_singular_value=viewer.smallest_singular_value(
                position, track_rotation=self._options.track == "pose"
            ),
            near=None if self._collision is None else self._collision.near(joints),
        )

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        """Return joint positions that move the TCP by `action`, or why the robot should hold.

        Args:
            action: TCP delta in the base frame and absolute gripper opening.
            joints: measured joints; the gripper's and others may be among them.
            step_s: time the action is meant for [s].

        Raises:
            StateError: called before `load`; nothing else.
        """
        options = self._options
        model, solver, bounds = self._loaded()
        measured = self._arm_position(model, joints)
        if isinstance(measured, Hold):
            return measured
        refusal = check_start(measured.tolist(), bounds) or check_action(action, step_s, options)
        if refusal is not None:
            return refusal
        here = solver.place(measured)
        target = solver.shift(here, action.translation_m, action.rotation_rad)
        refusal = check_workspace(here.translation, target.translation, self._profile.workspace)
        if refusal is not None:
            return refusal
        solution = self._solve(model, solver, measured, target)
        step = (solution.position - measured).tolist()
        refusal = check_solution(solution, options) or check_step(step, bounds)
        if refusal is not None:
            return refusal
        names, position = model.joints, solution.position
        if self._profile.gripper is not None:
            names = (*names, self._profile.gripper.joint)
            position = np.append(position, self._profile.gripper.to_position(action.gripper_open))
        return JointCommand(
            names=names,
            position=position,
            duration_s=max(step_s, shortest_duration_s(step, bounds)),
            residual_m=solution.residual_m,
            residual_rad=solution.residual_rad,
        )

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Return joint positions for a row of `ee_pose`, `joint_position` or `joint_velocity`, or
        why the robot should hold.

        Args:
            space: the robot's own space of that kind.
            row: float64 (n,), checked.
            joints: where the command in progress ends, or the measured joints.
            step_s: time the row is meant for [s].

        Raises:
            StateError: called before `load`; nothing else.
        """
        model, _, bounds = self._loaded()
        start = self._arm_position(model, joints)
        if isinstance(start, Hold):
            return start
        refusal = check_start(start.tolist(), bounds) or check_time(step_s)
        if refusal is not None:
            return refusal
        values = dict(zip((channel.name for channel in space.channels), row.tolist(), strict=True))
        solution: Solution | None = None
        if space.kind == "ee_pose":
            found = self._solve_pose(values, start)
            if isinstance(found, Hold):
                return found
            solution, target = found, found.position
        else:
            target = np.array([values[name] for name in model.joints])
            if space.kind == "joint_velocity":
                target = start + target * step_s
        step = (target - start).tolist()
        if (refusal := check_step(step, bounds)) is not None:
            return refusal
        names = model.joints
        if self._profile.gripper is not None:
            names = (*names, self._profile.gripper.joint)
            target = np.append(target, self._profile.gripper.to_position(values[GRIPPER]))
        return JointCommand(
            names=names,
            position=target,
            duration_s=max(step_s, shortest_duration_s(step, bounds)),
            residual_m=0.0 if solution is None else solution.residual_m,
            residual_rad=0.0 if solution is None else solution.residual_rad,
        )

    def _solve_pose(self, values: Mapping[str, float], start: F64) -> Solution | Hold:
        """Joints at an absolute pose of the TCP, seeded with those at the start."""
        options, (model, solver, _) = self._options, self._loaded()
        here = solver.place(start)
        target = pinocchio.SE3(
            pinocchio.Quaternion(*(values[f"q{name}"] for name in "wxyz")).normalized().matrix(),
            np.array([values[name] for name in "xyz"]),
        )
        turn = float(np.linalg.norm(pinocchio.log3(here.rotation.T @ target.rotation)))
        distance = float(np.linalg.norm(target.translation - here.translation))
        refusal = check_reach(distance, turn, options) or check_workspace(
            here.translation, target.translation, self._profile.workspace
        )
        if refusal is not None:
            return refusal
        solution = self._solve(model, solver, start, target)
        return check_solution(solution, options) or solution

    def _solve(
        self, model: ArmModel, solver: InverseKinematics, start: F64, target: pinocchio.SE3
    ) -> Solution:
        options = self._options
        return solver.solve(
            np.minimum(np.maximum(start, model.lower), model.upper),
            target,
            tolerance_m=options.position_tolerance_m * _STOP_FRACTION,
            tolerance_rad=options.rotation_tolerance_rad * _STOP_FRACTION,
            max_iterations=options.max_iterations,
            track_rotation=options.track == "pose",
        )

    def close(self) -> None:
        """Forget the arm."""
        self._model = self._solver = self._viewer = self._bounds = self._collision = None

    def _viewed(self, joints: JointSample) -> tuple[InverseKinematics, F64]:
        """The solver that only looks, and finite arm joints (n,); raises as `forward`."""
        model, viewer = self._model, self._viewer
        if model is None or viewer is None:
            raise _not_loaded()
        position = self._arm_position(model, joints)
        if isinstance(position, Hold):
            raise UnsafeError(position.reason)
        if not all(map(math.isfinite, position.tolist())):
            raise UnsafeError(
                f"A measured joint of {list(model.joints)} is not finite: {position.tolist()}."
            )
        return viewer, position

    def _loaded(self) -> tuple[ArmModel, InverseKinematics, tuple[JointBounds, ...]]:
        if self._model is None or self._solver is None or self._bounds is None:
            raise _not_loaded()
        return self._model, self._solver, self._bounds

    def _arm_position(self, model: ArmModel, joints: JointSample) -> F64 | Hold:
        """Measured arm joints (n,) in chain order, or why there are none."""
        names, indices = self._order
        if names != joints.names:
            missing = [name for name in model.joints if name not in joints.names]
            if missing:
                return Hold(
                    code=UNKNOWN_JOINT,
                    reason=f"The measured joints {list(joints.names)} lack {missing} of the arm.",
                )
            indices = [joints.names.index(name) for name in model.joints]
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
