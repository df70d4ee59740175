"""Prediction of an arm's motion by actions: control's controller and limits, on ideal joints that
follow at once.
"""

from __future__ import annotations

from typing import cast

from rn_standard.direct_path.allow_list import ArmPaths
from rn_standard.tools_arm.ee_line import F64
from roboneuron import (
    EE_DELTA,
    Action,
    Controller,
    ControlSpace,
    Hold,
    Host,
    JointCommand,
    JointSample,
    Pose,
    SpaceController,
)
from roboneuron.feature import ExposedEndpoint, MotionLimiter


def control_of(host: Host, exposed: ExposedEndpoint) -> tuple[Controller, MotionLimiter]:
    """Create a controller and limiter like control's, for one user, who closes the controller.

    Raises:
        ConfigurationError, MissingDependencyError, PluginError: there is no controller for the arm
            of that endpoint.
    """
    assert exposed.profile is not None
    config = host.loop.base
    paths = ArmPaths(config, lambda: host.registry, lambda: host.loop.limits)
    controller, profile = paths.load(exposed.robot, exposed.profile)
    limiter = MotionLimiter.of(
        paths.rules(exposed.robot, profile),
        profile,
        controller,
        immediate=config.control is not None and config.control.command == "joint_state",
        longest_s=config.robot.server_timeout_s,
    )
    return controller, limiter


class PredictedArm:
    """Simulated arms of a robot; used from one thread.

    Attributes:
        held: reason why the newest action was not executed; empty if it was, shortened or not.
    """

    def __init__(self, controller: Controller, limiter: MotionLimiter, joints: JointSample) -> None:
        """Args:
        controller, limiter: like control's, for exclusive use; the controller is loaded.
        joints: initial state, at rest.
        """
        self.held = ""
        self._controller, self._limiter, self._joints = controller, limiter, joints
        self._now_s = 0.0
        limiter.rest(joints, self._now_s)

    def poses(self) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame. Raises UnsafeError as `Controller.forward`."""
        return self._limiter.poses(self._joints)

    def follow(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """Execute a row of a space for `step_s`, as far as the limits allow; the arm stays in place
        if one holds it.
        """
        self._now_s += step_s
        outcome: JointCommand | Hold | None
        if space is EE_DELTA:
            outcome = self._controller.compute(Action.from_vector(row), self._joints, step_s)
        else:
            start = self._limiter.reference(self._joints, self._now_s)
            # checked by control
            spaces = cast("SpaceController", self._controller)
            outcome = spaces.execute(space, row, start, step_s)
        self.held = outcome.reason if isinstance(outcome, Hold) else ""
        if isinstance(outcome, JointCommand):
            verdict = self._limiter.limit(outcome, self._joints, self._now_s)
            outcome = verdict.command
            if not isinstance(outcome, JointCommand):
                self.held = verdict.reason
        if not isinstance(outcome, JointCommand):
            self._limiter.rest(self._joints, self._now_s)
            return
        share = min(1.0, step_s / outcome.duration_s)
        ends = dict(zip(outcome.names, outcome.position.tolist(), strict=True))
        position = self._joints.position.copy()
        for index, name in enumerate(self._joints.names):
            position[index] += share * (ends.get(name, position[index]) - position[index])
        self._joints = JointSample(
            names=self._joints.names, position=position, stamp_ns=self._joints.stamp_ns
        )

    def close(self) -> None:
        """Release the controller; may be called twice."""
        self._controller.close()
