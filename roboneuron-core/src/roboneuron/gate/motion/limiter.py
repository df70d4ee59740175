"""Motion limiter of the control module: applies every limit of `[limits]` to each joint command
before it is sent.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Self, cast

import numpy as np

from roboneuron.contract import (
    F64,
    Controller,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
)
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.command import (
    Answer,
    LimitedCommand,
    Setpoint,
    Step,
    pick,
    pick_others,
)
from roboneuron.gate.motion.rules import MotionRules, inspector_of, poses_of
from roboneuron.gate.motion.shortening import Rejection, Shortener

LOST, LOST_M = 0.1, 0.02
"""Largest difference between setpoint and measured joint [rad; m for prismatic joints] before the
setpoint counts as lost.
"""
_MEMORY_S = 1.0
"""Age at which the setpoint expires: the next command starts from the measured joints, at rest."""
_SHORTEST_S = 1e-3
"""Shortest interval between messages, against a division by zero when two arrive together."""
_ROUNDING_S = 1e-6
"""Tolerance for a horizon that is a whole number of periods."""


class MotionLimiter:
    """Limits successive joint commands of one robot relative to the last setpoint. Used from one
    thread.

    A command is passed unchanged, scaled, answered with a hold, or rejected ("refuse"), by the
    reaction configured for the limit. Scaling keeps the direction in joint space from the setpoint;
    only when the acceleration limits allow no velocity in that direction, the velocity changes from
    the present one towards the commanded one. A command that cannot be evaluated is answered with a
    hold. Limits of the TCP hold for each of several arms; a command that is scaled for one arm is
    scaled for all.

    Args:
        rules: numbers and reactions.
        profile: joints, limits and gripper of the robot.
        forward: TCP pose of a posture, of the first arm; raises UnsafeError.
        inspect: the same with all of `Posture`; raises UnsafeError.
        poses: TCP pose of each arm; needed for a robot with several arms.
        immediate: commands carry no time, so that the robot may jump to them (JointState commands).
        longest_s: longest duration of a command; a longer one is answered with a hold, as nothing
            could end it if control froze.
    """

    def __init__(
        self,
        rules: MotionRules,
        profile: RobotProfile,
        forward: Callable[[JointSample], Pose],
        inspect: Callable[[JointSample], Posture],
        *,
        poses: Callable[[JointSample], tuple[Pose, ...]] | None = None,
        immediate: bool = False,
        longest_s: float = math.inf,
    ) -> None:
        self._names = profile.arm_joints
        self.poses = poses or (lambda joints: (forward(joints),))
        self._shortener = Shortener(
            rules,
            profile,
            self.poses,
            inspect,
            immediate=immediate,
            longest_s=longest_s,
        )
        slides = profile.kinds.prismatic
        self._span, self._bounds = profile.kinds.span(self._names), profile.limits
        self._lost = np.array([LOST_M if name in slides else LOST for name in self._names])
        self._immediate, self._longest_s = immediate, longest_s
        self._sent: Setpoint | None = None
        self._expected: list[MotionLimiter] = []

    @classmethod
    def of(
        cls,
        rules: MotionRules,
        profile: RobotProfile,
        controller: Controller,
        *,
        immediate: bool,
        longest_s: float,
    ) -> Self:
        """Create a limiter with a controller's poses and postures. Arguments as of the class."""
        return cls(
            rules,
            profile,
            controller.forward,
            inspector_of(controller),
            poses=poses_of(controller),
            immediate=immediate,
            longest_s=longest_s,
        )

    def use(self, rules: MotionRules) -> None:
        """Apply other rules from the next command on.

        The setpoint is kept: the arm's motion continues, and the next step is evaluated relative to
        it.
        """
        self._shortener.use(rules)

    def limit(self, command: JointCommand, joints: JointSample, now_s: float) -> LimitedCommand:
        """Apply all limits to a command that is to be sent now.

        Args:
            command: command of the controller; `duration_s` is the time until the next one is
                expected, or longer.
            joints: newest measured joints.
            now_s: monotonic time.
        """
        if command.duration_s > self._longest_s:
            reason = (
                f"The controller's command lasts {command.duration_s:.3g} s, at most "
                f"{self._longest_s:g} s are allowed."
            )
            return LimitedCommand(
                command=Hold(code="long_command", reason=reason), reason=reason, share=0.0
            )
        self._advance(now_s)
        step: Step | None = None
        try:
            step = self._step(command, joints, now_s)
            wanted = step.target - step.start
            sent = self._shortener.shorten(step)
        except (UnsafeError, Rejection) as error:
            acted, hold = (), Hold(code="unsafe_command", reason=str(error))
            if isinstance(error, Rejection):
                acted, hold = (
                    (*(step.acted if step else ()), error.name),
                    replace(hold, code=f"limit_{error.name}"),
                )
            return LimitedCommand(
                command=None if isinstance(error, Rejection) and error.refuse else hold,
                acted=tuple(dict.fromkeys(acted)),
                reason=hold.reason,
                share=0.0,
                asked=step.asked if step else None,
                reference_lost=step is not None and step.is_lost,
            )
        asked_length = float(np.linalg.norm(wanted))
        sent_length = float(np.linalg.norm(step.target - step.start))
        self._commit(step, now_s)
        return LimitedCommand(
            command=self._command(command, step),
            acted=tuple(dict.fromkeys(step.acted)),
            reason=step.reason,
            share=sent_length / asked_length if step.acted and asked_length > 0.0 else 1.0,
            asked=step.asked,
            sent=sent,
            reference_lost=step.is_lost,
        )

    def plan(
        self,
        command: JointCommand,
        joints: JointSample,
        later: Sequence[Answer],
        step_s: float,
        horizon_s: float,
    ) -> list[JointCommand]:
        """Limit the commands planned after one that was just limited, each from the end of the
        previous one. The result ends before the first that cannot be executed.

        Args:
            command: as returned by `limit`.
            joints: measured.
            later: functions of the joints at the end of the previous command, the available time
                [s], and the start time [monotonic s].
            step_s: time for each command [s].
            horizon_s: longest total duration [s]; 0 for none.
        """
        commands, last = [command], self
        most_s = self._ends_s + horizon_s + _ROUNDING_S
        for answer in later if horizon_s else ():
            joints = _after(commands[-1], joints)
            begins_s = last._ends_s
            wanted = answer(joints, step_s, begins_s)
            if isinstance(wanted, Hold):
                break
            last = last._fork()
            limited = last.limit(wanted, joints, begins_s).command
            is_sent = isinstance(limited, JointCommand) and limited.names == command.names
            if not is_sent or last._ends_s > most_s:
                break
            self._expected.append(last)
            commands.append(cast("JointCommand", limited))
        return commands[1:]

    @property
    def _ends_s(self) -> float:
        """Monotonic time at which the last command ends; 0 without one."""
        return 0.0 if self._sent is None else self._sent.sent_s + self._sent.duration_s

    def _fork(self) -> Self:
        """Create an independent limiter with the same setpoint, for a command that begins when the
        last one ends.
        """
        other = copy.copy(self)
        other._expected = []
        return other

    def _advance(self, now_s: float) -> None:
        """Make the planned command that is in progress the setpoint, and discard the plan."""
        for fork in self._expected:
            if fork._sent is not None and fork._sent.sent_s <= now_s:
                self._sent = fork._sent
        self._expected = []

    def follow(self, command: JointCommand, joints: JointSample, sent_s: float) -> None:
        """Make a command that another process sent at the monotonic time `sent_s` the setpoint.

        After an invalid one there is no setpoint: the next command starts from the measured joints.
        """
        try:
            self._commit(self._step(command, joints, sent_s), sent_s)
        except UnsafeError:
            self._sent = None

    def reference(self, joints: JointSample, now_s: float) -> JointSample:
        """Joints at the end of the command in progress, for a command that adds to it.

        The measured joints if there is none, it is too old, or the arm does not follow it, so that
        no lag is made up for.
        """
        sent = self._sent
        if sent is None or now_s - sent.sent_s >= _MEMORY_S:
            return joints
        with suppress(UnsafeError):
            measured = pick(joints.names, joints.position, self._names)
            sent, position, _ = self._followed(sent, measured, now_s)
            if (np.abs(position - measured) <= self._lost).all():
                ends = np.array(joints.position)
                arm = [joints.names.index(name) for name in self._names]
                ends[arm] = sent.start + sent.displacement
                return replace(joints, position=ends)
        return joints

    def remaining_s(self, now_s: float) -> float:
        """Time until the command in progress ends; 0 without one."""
        sent = self._sent
        if sent is None or sent.immediate or not sent.displacement.any():
            return 0.0
        return max(0.0, sent.sent_s + sent.duration_s - now_s)

    def rest(self, joints: JointSample | None, now_s: float) -> None:
        """Make the measured joints the setpoint, at rest; None if they are unknown."""
        self._sent, self._expected = None, []
        if joints is None:
            return
        with suppress(UnsafeError):
            measured = pick(joints.names, joints.position, self._names)
            self._sent = Setpoint.at_rest(measured, now_s)

    def _followed(self, sent: Setpoint, measured: F64, now_s: float) -> tuple[Setpoint, F64, F64]:
        """A setpoint, and its position and velocity at a monotonic time, in the turns that the
        robot counts: it may measure a continuous joint a whole turn from where it was sent.
        """
        position, velocity = sent.at(now_s, self._shortener.accelerations.limits)
        near = self._span.nearest(measured, position)
        if near is position:
            return sent, position, velocity
        turns = near - position
        sent = replace(sent, start=sent.start + turns, goal=sent.goal + turns)
        return sent, near, velocity

    def _commit(self, step: Step, now_s: float) -> None:
        self._sent = Setpoint(
            start=step.start,
            displacement=step.target - step.start,
            duration_s=step.duration_s,
            sent_s=now_s,
            immediate=self._immediate,
            goal=step.goal,
            goal_velocity=step.last.goal_velocity_to(step.goal, step.duration_s, now_s),
        )

    def _step(self, command: JointCommand, joints: JointSample, now_s: float) -> Step:
        """Convert the command to a straight line from the setpoint, or from the measured joints if
        there is no setpoint, it has expired, or the arm does not follow it.

        Raises:
            UnsafeError: joints are missing or not finite, or the duration is not finite and
                positive.
        """
        measured = pick(joints.names, joints.position, self._names)
        target = pick(command.names, command.position, self._names)
        if not (math.isfinite(command.duration_s) and command.duration_s > 0.0):
            raise UnsafeError(
                f"A command lasts {command.duration_s} s, expected a finite time > 0."
            )
        since_s = math.inf if self._sent is None else now_s - self._sent.sent_s
        last = self._sent if since_s < _MEMORY_S else None
        is_lost = False
        if last is not None:
            last, start, before = self._followed(last, measured, now_s)
            is_lost = bool((np.abs(start - measured) > self._lost).any())
        if last is None or is_lost:
            last = Setpoint.at_rest(measured, now_s)
            start, before = measured, last.displacement
        low, high = (
            (None, None) if self._bounds is None else (self._bounds.lower, self._bounds.upper)
        )
        target = self._span.nearest(start, target, low, high)
        duration_s = max(
            _SHORTEST_S, min(command.duration_s, since_s) if self._immediate else command.duration_s
        )
        return Step(
            measured=measured,
            last=last,
            start=start,
            before=before,
            target=target,
            goal=target,
            goal_velocity=last.steady_velocity_to(target, duration_s, now_s),
            duration_s=duration_s,
            passed_s=max(0.0, min(since_s, duration_s)),
            stamp_ns=joints.stamp_ns,
            others=pick_others(command, joints, self._names, self._shortener.limits),
            is_lost=is_lost,
        )

    def _command(self, command: JointCommand, step: Step) -> JointCommand:
        """Return the command to send: itself, or a copy whose arm joints end at the step's target;
        the gripper keeps its commanded target.
        """
        is_same = not step.acted and step.duration_s == command.duration_s
        if is_same and not self._span.is_turning:
            return command
        position = command.position.copy()
        position[[command.names.index(name) for name in self._names]] = step.target
        return replace(command, position=position, duration_s=step.duration_s)


def _after(command: JointCommand, joints: JointSample) -> JointSample:
    """The joints at the end of `command`."""
    ends = dict(zip(command.names, command.position.tolist(), strict=True))
    position = [
        ends.get(name, place)
        for name, place in zip(joints.names, joints.position.tolist(), strict=True)
    ]
    return replace(joints, position=np.array(position), velocity=None)
