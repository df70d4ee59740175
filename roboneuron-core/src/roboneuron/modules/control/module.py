"""Control module: from actions and measured joints to joint commands within the limits."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import cast

from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from roboneuron.contract import (
    EE_DELTA,
    Action,
    Controller,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    PostureInspector,
    RobotProfile,
    SeveralArms,
    SpaceController,
    joints_from_message,
    robot_space,
)
from roboneuron.contract.arrays import F64
from roboneuron.errors import ConfigurationError, InvalidInputError, RoboNeuronError
from roboneuron.gate.motion.command import Asked
from roboneuron.modules.control.planning import find_controller
from roboneuron.modules.holding import HoldingModule
from roboneuron.modules.module_host import ModuleHost
from roboneuron.modules.plugin import build
from roboneuron.modules.settings import COLLISION_CHECKED
from roboneuron.modules.step_filters import ActionStep
from roboneuron.moved import Moved
from roboneuron.planning import find_robot
from roboneuron.plugins.specs import ControllerSpec
from roboneuron.ros import messages, topics

__all__ = ["ControlModule"]
"""Names that other distributions may use."""

_POSE_PERIOD_S = 0.02
"""Period of computing the TCP pose, much lower than the rate of joint states (up to 1000 Hz)."""
_SHARE_OF_REST = 0.5
"""Fraction of a row's remaining time that is added to the next row's time: with all of it the arm
would lag for ever, with none it would catch up at once.
"""
log = logging.getLogger(__name__)


class ControlModule(HoldingModule):
    """Computes a command for each action; runs on the executor's thread.

    Attributes:
        controller: computes the commands; not thread-safe.
        spaces: executable spaces, by label.
        space: space of the newest action; None before the first, so that its label is always
            checked.
    """

    deliver = Moved("StepFilter.act")

    def __init__(self, node: ModuleHost) -> None:
        """Load the controller and subscribe.

        Raises:
            ConfigurationError: there is no [control] section, the limits do not fit the robot, or
                the tightened limits are wider than the configured ones.
            PlanningError: the controller cannot move this robot.
        """
        super().__init__(node)
        self._pose_s = 0.0
        robot, _ = find_robot(
            self.registry, self.profile.name, self.config.robot.driver, is_elsewhere=True
        )
        spec = find_controller(self.registry, self.section.controller, robot)
        self.controller = cast(
            "Controller", build(spec, self.config.options(spec.name), self.profile)
        )
        node.resources.callback(self.controller.close)
        self.controller.load()
        self.spaces = _executed_spaces(spec, self.controller, self.profile)
        self.space: ControlSpace | None = None
        self.limit_with(self.controller)
        self._report_collision_check()
        self._ee_pose = node.advertise(PoseStamped, topics.EE_POSE)
        self._arm_poses = [
            node.advertise(PoseStamped, f"{arm.name}/{topics.EE_POSE}") for arm in self.profile.arms
        ]
        node.subscribe(JointState, topics.JOINT_STATES, self._on_joint_state)
        node.subscribe(Float64MultiArray, topics.ACTION, self._on_action)
        self.status.set_value("controller", spec.name)

    def _report_collision_check(self) -> None:
        """Report whether collisions are checked, which not every controller supports."""
        has_bodies = self.profile.collision is not None
        is_checked = has_bodies and isinstance(self.controller, PostureInspector)
        if has_bodies and not is_checked:
            log.warning(
                "The controller tells no distances: collisions of %s are not checked.",
                self.profile.name,
            )
        self.status.set_value(COLLISION_CHECKED, is_checked)

    def _on_joint_state(self, message: JointState) -> None:
        now_s = time.monotonic()
        try:
            joints = joints_from_message(message)
            if not self.believe(joints, now_s):
                return
            if now_s - self._pose_s >= _POSE_PERIOD_S or not self.filters.sends(joints.stamp_ns):
                self._publish_pose(joints)
                self._pose_s = now_s
        except RoboNeuronError as error:
            self.status.drop("bad_joint_state")
            self.status.set_error(error)

    def _publish_pose(self, joints: JointSample) -> None:
        """Publish the measured TCP of each arm, which is the readiness check of control.

        Raises:
            UnsafeError: the controller cannot compute it from these joints.
        """
        poses = self.poses(joints)
        if not self.filters.sends(joints.stamp_ns):
            self.filters.withhold(poses[0])
        elif self.filters.admits(joints.stamp_ns):
            self._send_poses(poses)
            self.filters.note_sent("pose")
        self.status.clear_error()
        self.status.set_ready()

    def _send_poses(self, poses: tuple[Pose, ...]) -> None:
        """Publish the first arm's pose as the robot's, and that of each of several arms on its own
        topic.
        """
        self._ee_pose.publish(messages.to_pose_stamped(poses[0], self.profile.base_link))
        for publisher, pose in zip(self._arm_poses, poses, strict=False):
            publisher.publish(messages.to_pose_stamped(pose, self.profile.base_link))

    def _on_action(self, message: Float64MultiArray, info: Mapping[str, int]) -> None:
        """Pass an action through the filters and execute it, or count the reason for dropping it.
        Its age is measured from the DDS source time stamp, since the message has none.
        """
        step = ActionStep(
            source_ns=int(info["source_timestamp"]), read=partial(self._read, message)
        )
        self.filters.act(step, lambda one: self.act(one.source_ns, one.read))

    def _read(self, message: Float64MultiArray) -> Asked:
        """Return the content of an action.

        Raises:
            InvalidInputError: it is malformed, or of a space that this control does not execute.
            UnsafeError: it is not finite.
        """
        label, values = messages.row_from_action_message(message)
        space = self.space
        if space is None or label != space.label:
            space = self.space = self._agreed_space(label)
        now = partial(self._compute, space, space.check(values))
        planned = messages.PlannedRows.from_action_message(message)
        if planned is None:
            return Asked(now=now)
        rows = [space.check(row) for row in planned.rows]
        # a displacement or a velocity is relative to the measured arm when it is due: executed
        # ahead of its time it would count twice
        if not space.is_absolute:
            return Asked(now=now)
        # checked by `_executed_spaces`
        controller = cast("SpaceController", self.controller)
        later = tuple(partial(_execute, controller, space, row) for row in rows)
        return Asked(now=now, later=later, step_s=planned.step_s)

    def _agreed_space(self, label: str) -> ControlSpace:
        """Return the space of an action by its label. Raises InvalidInputError for a space that
        this control does not execute.
        """
        name, rate_hz = _split(label)
        space = self.spaces.get(name)
        if space is not None and rate_hz:
            space = replace(space, rate_hz=rate_hz)
        # the second: an invalid rate, or one of a space without a rate
        if space is None or space.label != label:
            raise InvalidInputError(
                f"An action is labelled {label!r}; this control executes "
                f"{', '.join(map(repr, self.spaces))}."
            )
        if space.kind == "joint_velocity" and not rate_hz:
            raise InvalidInputError(
                f"An action is labelled {label!r}, which does not say how long a velocity is held; "
                "expected 'joint_velocity@<rows per second>:...'."
            )
        return space

    def _compute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float, now_s: float
    ) -> JointCommand | Hold:
        """Return the controller's command for one row."""
        if space.kind == EE_DELTA.kind:
            return self.controller.compute(Action.from_vector(row), joints, step_s)
        # checked by `_executed_spaces`
        controller = cast("SpaceController", self.controller)
        # A velocity lasts for one period of the policy, whenever its message arrives. Positions
        # have to be reached when the next row is due.
        if space.rate_hz:
            step_s = 1.0 / space.rate_hz
        answer = controller.execute(space, row, self.reference(joints, now_s), step_s)
        if space.rate_hz and isinstance(answer, JointCommand):
            # Its message came early, or the previous one late: the rest of that one is not rushed,
            # or the limits would cut off a part of a steady motion.
            more_s = _SHARE_OF_REST * self.remaining_s(now_s)
            answer = replace(answer, duration_s=answer.duration_s + more_s)
        return answer


def _execute(
    controller: SpaceController,
    space: ControlSpace,
    row: F64,
    joints: JointSample,
    step_s: float,
    _now_s: float,
) -> JointCommand | Hold:
    """Return the controller's command for a planned row."""
    return controller.execute(space, row, joints, step_s)


def _split(label: str) -> tuple[str, float]:
    """Split a label into the part without the rate, and the rate [Hz]; 0 for a missing or invalid
    rate.
    """
    kind, colon, keys = label.partition(":")
    kind, _, rate = kind.partition("@")
    try:
        rate_hz = float(rate or 0.0)
    except ValueError:
        rate_hz = 0.0
    return f"{kind}{colon}{keys}", rate_hz


def _executed_spaces(
    spec: ControllerSpec, controller: Controller, profile: RobotProfile
) -> dict[str, ControlSpace]:
    """Return the executable spaces, by label. Raises ConfigurationError if the controller does not
    implement its descriptor.
    """
    # inference resolves `joint_delta`, which is never sent; a 7-vector is for one arm
    never = {"joint_delta", *(("ee_delta",) if profile.arms else ())}
    kinds = [kind for kind in spec.spaces if kind not in never]
    if profile.arms and not (kinds and isinstance(controller, SeveralArms)):
        raise ConfigurationError(
            f"Controller {spec.name!r} moves one arm; robot {profile.name!r} has "
            f"{len(profile.arms)}.",
            hint="Choose a controller for several arms, such as 'urdf'.",
        )
    if kinds != ["ee_delta"] and not isinstance(controller, SpaceController):
        raise ConfigurationError(
            f"Controller {spec.name!r} declares {', '.join(kinds)}, but has no `execute`."
        )
    spaces = (robot_space(kind, profile) for kind in kinds)
    return {space.label: space for space in spaces}
