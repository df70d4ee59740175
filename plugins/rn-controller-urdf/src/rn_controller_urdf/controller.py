"""The controller "urdf": converts a row of any control space and measured joints to a joint
command, or refuses with the reason.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.arm import ArmKinematics
from rn_controller_urdf.collision import CollisionModel
from rn_controller_urdf.options import UrdfControllerOptions
from rn_controller_urdf.refusals import (
    BAD_ACTION,
    check_action,
    check_row,
    check_solution,
    check_start,
    check_step,
    check_time,
    shortest_duration_s,
)
from rn_controller_urdf.shapes import LinkBoxes
from roboneuron import (
    GRIPPER,
    Action,
    ConfigurationError,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    LinkExtents,
    Pose,
    Posture,
    Proximity,
    RobotProfile,
    StateError,
    UnsafeError,
    robot_space,
)

F64 = NDArray[np.float64]

_EXECUTED = ("ee_pose", "joint_position", "joint_velocity")
"""Kinds of control spaces in addition to `ee_delta`."""


def _none() -> LinkExtents:
    return LinkExtents(names=(), lower_m=np.empty((0, 3)), upper_m=np.empty((0, 3)))


def _joined(parts: list[JointCommand]) -> JointCommand:
    """Combine the commands of several arms to one, with the duration of the slowest."""
    return JointCommand(
        names=tuple(name for part in parts for name in part.names),
        position=np.concatenate([part.position for part in parts]),
        duration_s=max(part.duration_s for part in parts),
        residual_m=max(part.residual_m for part in parts),
        residual_rad=max(part.residual_rad for part in parts),
    )


class UrdfController:
    """Differential inverse kinematics on the URDF of `profile`; seeded with the measured joints,
    stateless.

    A command that would exceed the joints' velocity limits over `step_s` gets more time
    (`JointCommand.duration_s` >= step_s). A robot with several arms gets one command for all, or
    one refusal. Not thread-safe; `forward` may run in parallel with `compute`.
    """

    def __init__(self, config: UrdfControllerOptions | None, profile: RobotProfile) -> None:
        self._options = config or UrdfControllerOptions()
        self._profile = profile
        self._arms: tuple[ArmKinematics, ...] = ()
        self._collision: CollisionModel | None = None
        self._boxes: LinkBoxes | None = None
        self._channel_keys: dict[str, tuple[str, ...]] = {}

    def load(self) -> None:
        """Parse the URDF and build the arms.

        Raises:
            ConfigurationError: the profile's URDF, links, joints or limits do not form an arm.
        """
        profile = self._profile
        self._arms = tuple(ArmKinematics(self._options, profile, arm) for arm in profile.each_arm)
        if profile.collision is not None:
            self._collision = CollisionModel(profile, profile.collision)

    def forward(self, joints: JointSample) -> Pose:
        """TCP pose in the base frame, stamped as the joints are; of the first arm.

        Raises:
            UnsafeError: an arm joint is missing or not finite.
            StateError: called before `load`.
        """
        return self._loaded()[0].pose(joints)

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        """TCP pose of each arm. Raises as `forward`."""
        return tuple(arm.pose(joints) for arm in self._loaded())

    def inspect(self, joints: JointSample) -> Posture:
        """TCP poses, smallest singular values and, if the profile requests it, bodies that are too
        close. Raises as `forward`.
        """
        views = [arm.view(joints) for arm in self._loaded()]
        (pose, singular), *others = views
        poses = tuple(each for each, _ in views)
        return Posture(
            pose=pose,
            smallest_singular_value=singular,
            near=None if self._collision is None else self._collision.near(joints),
            extents=lambda: self._extents(joints, poses),
            others=tuple(
                Posture(pose=other, smallest_singular_value=value, extents=_none)
                for other, value in others
            ),
        )

    def _extents(self, joints: JointSample, poses: tuple[Pose, ...]) -> LinkExtents:
        """Boxes around the links, whose shapes are built when a limit asks for them first. Raises
        UnsafeError.
        """
        if self._boxes is None:
            try:
                self._boxes = LinkBoxes(self._profile)
            except ConfigurationError as error:
                raise UnsafeError(error.message) from error
        return self._boxes.extents(joints, poses)

    def distances(self, joints: JointSample) -> tuple[Proximity, ...]:
        """Distances of links to each other and to obstacles, the nearest first; () where the
        profile asks for none. Raises as `forward`.
        """
        for arm in self._loaded():
            arm.pose(joints)
        return () if self._collision is None else self._collision.distances(joints)

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        """Return joint positions that move the TCP by `action`, or the reason to hold.

        Args:
            action: TCP delta in the base frame and absolute gripper opening.
            joints: measured joints; the gripper's and others may be included.
            step_s: duration of the action [s].

        Raises:
            StateError: called before `load`; nothing else.
        """
        arm, *others = self._loaded()
        if others:
            return Hold(
                code=BAD_ACTION,
                reason=f"The 7-vector moves one arm, the robot has {len(others) + 1}.",
            )
        measured = arm.position(joints)
        if isinstance(measured, Hold):
            return measured
        refusal = check_start(measured.tolist(), arm.bounds) or check_action(
            action, step_s, self._options
        )
        if refusal is not None:
            return refusal
        here = arm.solver.place(measured)
        target = arm.solver.shift(here, action.translation_m, action.rotation_rad)
        refusal = arm.check_target(here.translation, target.translation)
        if refusal is not None:
            return refusal
        solution = arm.solve(measured, target)
        step = (solution.position - measured).tolist()
        refusal = check_solution(solution, self._options) or check_step(step, arm.bounds)
        if refusal is not None:
            return refusal
        names, position = arm.model.joints, solution.position
        if arm.gripper is not None:
            names = (*names, arm.gripper.joint)
            position = np.append(position, arm.gripper.to_position(action.gripper_open))
        return JointCommand(
            names=names,
            position=position,
            duration_s=max(step_s, shortest_duration_s(step, arm.bounds)),
            residual_m=solution.residual_m,
            residual_rad=solution.residual_rad,
        )

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Return joint positions for a row of `ee_pose`, `joint_position` or `joint_velocity`, or
        the reason to hold.

        Args:
            space: the robot's own space of that kind.
            row: float64 (n,), checked.
            joints: at the end of the command in progress, or measured.
            step_s: duration of the row [s].

        Raises:
            StateError: called before `load`; nothing else.
        """
        arms = self._loaded()
        refusal = check_row(space, row, self._keys(space.kind))
        if refusal is not None:
            return refusal
        parts: list[JointCommand] = []
        for arm in arms:
            values = {
                channel.name: value
                for channel, value in zip(space.channels, row.tolist(), strict=True)
                if channel.arm == arm.name
            }
            part = self._execute(arm, space.kind, values, joints, step_s)
            if isinstance(part, Hold):
                return arm.told(part)
            parts.append(part)
        return parts[0] if len(parts) == 1 else _joined(parts)

    def _execute(
        self,
        arm: ArmKinematics,
        kind: str,
        values: dict[str, float],
        joints: JointSample,
        step_s: float,
    ) -> JointCommand | Hold:
        """Compute the command of one arm from its channels by name."""
        start = arm.position(joints)
        if isinstance(start, Hold):
            return start
        refusal = check_start(start.tolist(), arm.bounds) or check_time(step_s)
        if refusal is not None:
            return refusal
        residual_m = residual_rad = 0.0
        if kind == "ee_pose":
            found = arm.solve_pose(values, start)
            if isinstance(found, Hold):
                return found
            target, residual_m, residual_rad = found.position, found.residual_m, found.residual_rad
        else:
            target = np.array([values[name] for name in arm.model.joints])
            if kind == "joint_velocity":
                target = start + target * step_s
            else:
                target = arm.span.nearest(start, target, arm.model.lower, arm.model.upper)
        step = (target - start).tolist()
        if (refusal := check_step(step, arm.bounds)) is not None:
            return refusal
        names = arm.model.joints
        if arm.gripper is not None:
            names = (*names, arm.gripper.joint)
            target = np.append(target, arm.gripper.to_position(values[GRIPPER]))
        return JointCommand(
            names=names,
            position=target,
            duration_s=max(step_s, shortest_duration_s(step, arm.bounds)),
            residual_m=residual_m,
            residual_rad=residual_rad,
        )

    def _keys(self, kind: str) -> tuple[str, ...]:
        """Channel names of the robot's own space of that kind; empty without one."""
        if kind not in self._channel_keys:
            is_ours = kind in _EXECUTED
            self._channel_keys[kind] = robot_space(kind, self._profile).keys if is_ours else ()
        return self._channel_keys[kind]

    def close(self) -> None:
        """Release the arms."""
        self._arms, self._collision, self._boxes = (), None, None

    def _loaded(self) -> tuple[ArmKinematics, ...]:
        if not self._arms:
            raise StateError(
                "The controller 'urdf' was used before it was loaded.", hint="Call load() first."
            )
        return self._arms
