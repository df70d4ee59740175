"""Prediction of an arm's motion by actions: control's controller and limits, on ideal joints that
follow at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast

from roboneuron.contract import (
    EE_DELTA,
    Action,
    Controller,
    ControlSpace,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    SpaceController,
)
from roboneuron.gate.motion.limiter import MotionLimiter
from roboneuron.modules.arm_paths import ArmPaths
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.tools.arm.ee_line import F64

__all__ = ["answer_to"]
"""Names that other distributions may use."""


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


class DrivenArm(Protocol):
    """What carries out rows, of a robot that is computed or simulated.

    Attributes:
        held: why the newest row was not carried out; empty when it was, shortened or not.
    """

    held: str

    def poses(self) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame. Raises UnsafeError."""

    def follow(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """Carry out a row of a space for `step_s`, as far as the limits allow."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Answered:
    """What control makes of a row.

    Attributes:
        command: within the limits; None where the arm is held.
        held: why; empty otherwise.
        rules: limits, by name, that shortened the command or held the arm, or the controller's code
            of a hold.
        is_ignored: the row was refused: the command before it comes to its end.
    """

    command: JointCommand | None
    held: str = ""
    is_ignored: bool = False
    rules: tuple[str, ...] = ()


def answer_to(
    controller: Controller,
    limiter: MotionLimiter,
    space: ControlSpace,
    row: F64,
    joints: JointSample,
    now_s: float,
    step_s: float,
) -> Answered:
    """What control makes of a row.

    Args:
        controller, limiter: as control has them.
        space, row: what is asked for.
        joints: measured.
        now_s: time, as `MotionLimiter` counts it.
        step_s: time that the row has.
    """
    answer: JointCommand | Hold
    if space is EE_DELTA:
        answer = controller.compute(Action.from_vector(row), joints, step_s)
    else:
        start = limiter.reference(joints, now_s)
        # control has looked whether it can
        answer = cast("SpaceController", controller).execute(space, row, start, step_s)
    if isinstance(answer, Hold):
        return Answered(command=None, held=answer.reason, rules=(answer.code,))
    verdict = limiter.limit(answer, joints, now_s)
    if isinstance(verdict.command, JointCommand):
        return Answered(command=verdict.command, rules=verdict.acted)
    is_ignored = verdict.command is None
    return Answered(command=None, held=verdict.reason, rules=verdict.acted, is_ignored=is_ignored)


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
        answered = answer_to(
            self._controller, self._limiter, space, row, self._joints, self._now_s, step_s
        )
        outcome, self.held = answered.command, answered.held
        if outcome is None:
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
