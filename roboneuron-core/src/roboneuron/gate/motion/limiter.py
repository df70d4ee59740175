"""Motion limiter of the control module: applies every limit of `[limits]` to each joint command
before it is sent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Self

import numpy as np

from roboneuron.contract import (
    F64,
    STATE_STEP_S,
    Controller,
    Hold,
    JointCommand,
    JointSample,
    Pose,
    Posture,
    RobotProfile,
    prismatic_joints,
)
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.command import Goals, LimitedCommand, Setpoint, Step, pick, pick_others
from roboneuron.gate.motion.joint_space import JointLimit, JointSpace
from roboneuron.gate.motion.path import Reach
from roboneuron.gate.motion.rules import MotionRules, inspector_of, poses_of
from roboneuron.gate.motion.task_space import Motion, TaskSpace, largest

LOST, LOST_M = 0.1, 0.02
"""Largest difference between setpoint and measured joint [rad; m for slides] before the setpoint
counts as lost.
"""
_MEMORY_S = 1.0
"""Age at which the setpoint expires: the next command starts from the measured joints, at rest."""
_SHORTEST_S = 1e-3
"""Two messages that arrive together are no reason to divide by nothing."""
_HALVINGS = 6
"""Bisections when a step is shortened to stay out of a zone: to 1/64 of the step."""
_RESERVE = 0.98
"""Share of a Cartesian limit used when a step is scaled: a straight line in joint space is a curve
in task space.
"""


class _Rejection(Exception):
    """A limit rejects the command: its reaction is "hold" or "refuse", or no scaled command is
    within the limits.
    """

    def __init__(self, name: str, reason: str, *, refuse: bool = False) -> None:
        super().__init__(reason)
        self.name, self.refuse = name, refuse


def _ratio(of_all: float, of_step: float) -> float:
    """How many steps the whole path has, from the lengths of both; 1 without a step."""
    return of_all / of_step if of_step > 0.0 else 1.0


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
        inspect: the same with all that `Posture` holds; raises likewise.
        poses: TCP pose of each arm; needed for a robot that has several.
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
        self._profile = profile
        self._names = profile.arm_joints
        self.use(rules)
        self._reach = Reach(profile)
        slides = prismatic_joints(profile.urdf)
        self._lost = np.array([LOST_M if name in slides else LOST for name in self._names])
        self._checks_path = profile.collision is not None
        self._poses = poses or (lambda joints: (forward(joints),))
        self._inspect = inspect
        self._arms = [f"{arm.name}: " if arm.name else "" for arm in profile.each_arm]
        self._immediate, self._longest_s = immediate, longest_s
        self._sent: Setpoint | None = None
        self._goals = Goals()

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
        """One that asks a controller for poses and postures. Arguments as of the class."""
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
        """Apply other numbers and reactions from the next command on.

        The setpoint is kept: the arm's motion goes on, and the next step is judged by it.
        """
        self._rules = rules
        self._limits = JointLimit.by_joint(self._profile, rules)
        self._joints = JointSpace(
            self._names, [self._limits.get(name, JointLimit()) for name in self._names]
        )
        self._task = TaskSpace(rules)

    def limit(self, command: JointCommand, joints: JointSample, now_s: float) -> LimitedCommand:
        """Apply all limits to a command that is to be sent now.

        Args:
            command: of the controller; `duration_s` is the time until the next one is expected, or
                longer.
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
        step: Step | None = None
        try:
            step = self._step(command, joints, now_s)
            wanted = step.target - step.start
            sent = self._shorten(step)
        except (UnsafeError, _Rejection) as error:
            acted, hold = (), Hold(code="unsafe_command", reason=str(error))
            if isinstance(error, _Rejection):
                acted, hold = (
                    (*(step.acted if step else ()), error.name),
                    replace(hold, code=f"limit_{error.name}"),
                )
            return LimitedCommand(
                command=None if isinstance(error, _Rejection) and error.refuse else hold,
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

    def follow(self, command: JointCommand, joints: JointSample, sent_s: float) -> None:
        """Take a command that another process sent, at the monotonic time `sent_s`, as the
        setpoint.

        After an invalid one there is no setpoint: the next command starts from the measured joints.
        """
        try:
            self._commit(self._step(command, joints, sent_s), sent_s)
        except UnsafeError:
            self._sent = None

    def reference(self, joints: JointSample, now_s: float) -> JointSample:
        """Joints at the end of the command in progress, for a command that adds to it.

        The measured ones when there is none, when it is too old, or when the arm does not follow
        it: then nothing is to be made up for.
        """
        sent = self._sent
        if sent is None or now_s - sent.sent_s >= _MEMORY_S:
            return joints
        with suppress(UnsafeError):
            measured = pick(joints.names, joints.position, self._names)
            position, _ = sent.at(now_s, self._joints.braking)
            if (np.abs(position - measured) <= self._lost).all():
                ends = np.array(joints.position)
                arm = [joints.names.index(name) for name in self._names]
                ends[arm] = sent.start + sent.displacement
                return replace(joints, position=ends)
        return joints

    def remaining_s(self, now_s: float) -> float:
        """Time until the command in progress has ended; 0 where there is none."""
        sent = self._sent
        if sent is None or sent.immediate or not sent.displacement.any():
            return 0.0
        return max(0.0, sent.sent_s + sent.duration_s - now_s)

    def rest(self, joints: JointSample | None, now_s: float) -> None:
        """Take the measured joints as the setpoint, at rest; None: they are not known."""
        self._sent = None
        if joints is None:
            return
        with suppress(UnsafeError):
            measured = pick(joints.names, joints.position, self._names)
            self._goals.restart(measured, now_s)
            self._sent = Setpoint(
                start=measured,
                displacement=np.zeros_like(measured),
                duration_s=1.0,
                sent_s=now_s,
                immediate=self._immediate,
            )

    def _commit(self, step: Step, now_s: float) -> None:
        self._goals.take(step.goal, step.duration_s, now_s)
        self._sent = Setpoint(
            start=step.start,
            displacement=step.target - step.start,
            duration_s=step.duration_s,
            sent_s=now_s,
            immediate=self._immediate,
        )

    def _step(self, command: JointCommand, joints: JointSample, now_s: float) -> Step:
        """The command as a straight line from the setpoint, or from the measured joints where there
        is no setpoint, it has expired, or the arm does not follow it.

        Raises:
            UnsafeError: joints are missing or not finite, or it lasts no finite time > 0.
        """
        measured = pick(joints.names, joints.position, self._names)
        target = pick(command.names, command.position, self._names)
        if not (math.isfinite(command.duration_s) and command.duration_s > 0.0):
            raise UnsafeError(
                f"A command lasts {command.duration_s} s, expected a finite time > 0."
            )
        since_s = math.inf if self._sent is None else now_s - self._sent.sent_s
        start, before, is_lost = measured, np.zeros_like(measured), False
        if self._sent is not None and since_s < _MEMORY_S:
            position, velocity = self._sent.at(now_s, self._joints.braking)
            is_lost = bool((np.abs(position - measured) > self._lost).any())
            if not is_lost:
                start, before = position, velocity
        if start is measured:
            self._goals.restart(measured, now_s)
        duration_s = max(
            _SHORTEST_S, min(command.duration_s, since_s) if self._immediate else command.duration_s
        )
        return Step(
            measured=measured,
            start=start,
            before=before,
            target=target,
            goal=target,
            goal_velocity=self._goals.velocity(target, duration_s, now_s),
            duration_s=duration_s,
            passed_s=max(0.0, min(since_s, duration_s)),
            stamp_ns=joints.stamp_ns,
            others=pick_others(command, joints, self._names, self._limits),
            is_lost=is_lost,
        )

    def _shorten(self, step: Step) -> Motion:
        """Scale the step's target to within the limits; returns the motion that is sent, raises
        _Rejection.
        """
        measured = start = self._poses(self._sample(step, step.measured))
        if step.start is not step.measured:
            start = self._poses(self._sample(step, step.start))
        target = self._evaluate(step, step.target)
        asked = self._motions(step, measured, start, target)
        step.asked = largest(asked)
        self._apply_joint_limits(step, asked, measured, target)
        if step.acted:
            target = self._evaluate(step, step.target)
        target = self._apply_cartesian_limits(step, measured, target)
        sent = step.asked
        if step.acted:
            # Check what would be sent once more: scaling for one limit may violate another one.
            sent = largest(self._motions(step, measured, start, target))
            displacement = step.target - step.start
            for name, _, reason in self._joints.violations(
                step.start, displacement, step.duration_s
            ):
                raise _Rejection(name, f"No part of the command is within the limits: {reason}")
            if not self._joints.is_reachable(
                step.before, displacement / step.duration_s, step.passed_s
            ):
                raise _Rejection(
                    "acceleration", f"The arm is too fast for a limit before it: {step.reason}"
                )
            for name, _, reason in self._task.excess(sent):
                raise _Rejection(name, reason)
            for name, reason in self._cartesian_violations(step, measured, target):
                raise _Rejection(name, reason)
        if self._extend(step, measured, target):
            sent = largest(self._motions(step, measured, start, target))
        return sent

    def _extend(self, step: Step, measured: tuple[Pose, ...], target: Posture) -> bool:
        """Give the command the time that the TCP needs from where it is measured; returns whether
        it needed more.

        The limit of speed holds from the setpoint. An arm that was held up (a late command, a
        frozen driver) is behind it and would catch up in the time of the command.
        """
        if self._immediate:
            return False
        times = self._speed_ratio(measured, target, step.duration_s)
        if times <= 1.0:
            return False
        displacement, least_s = step.target - step.start, step.duration_s
        most_s = min(least_s * times / _RESERVE, self._longest_s)
        if not self._joints.is_reachable(step.before, displacement / most_s, step.passed_s):
            for _ in range(_HALVINGS):  # it brakes no harder than the joints may
                middle_s = (least_s + most_s) / 2.0
                if self._joints.is_reachable(step.before, displacement / middle_s, step.passed_s):
                    least_s = middle_s
                else:
                    most_s = middle_s
            most_s = least_s
        step.duration_s = most_s
        return True

    def _speed_ratio(self, measured: tuple[Pose, ...], target: Posture, duration_s: float) -> float:
        """How many times a speed limit a TCP would have on its path from the measured pose."""
        motions = [
            self._task.motion(pose, pose, end, duration_s, 0.0)
            for pose, end in zip(measured, target.arms, strict=True)
        ]
        excess = self._task.excess(largest(motions))
        return max((times for name, times, _ in excess if name == "speed"), default=1.0)

    def _apply_joint_limits(
        self, step: Step, asked: Sequence[Motion], measured: tuple[Pose, ...], target: Posture
    ) -> None:
        """Scale the step to the limits of joints, TCP step and TCP speed."""
        displacement, share = step.target - step.start, 1.0
        if self._immediate and (times := self._speed_ratio(measured, target, STATE_STEP_S)) > 1.0:
            self._act(
                step,
                "speed",
                f"The arm is behind its setpoint; its TCP would be {times:.3g} times too fast.",
            )
            # The arm has to cover two parts: what it is behind, and the step. Only the step can be
            # scaled: (behind + share * step) / (behind + step) = _RESERVE / times, solved for
            # share, with whole / step = `parts`; once for distances, once for turns.
            parts = [_ratio(motion.step_m, motion.speed_m_s * step.duration_s) for motion in asked]
            parts += [_ratio(arm.step_rad, arm.turn_rad_s * step.duration_s) for arm in asked]
            share = max(0.0, 1.0 - (1.0 - _RESERVE / times) * max(parts))
        for name, part, reason in self._joints.violations(
            step.start, displacement, step.duration_s
        ):
            self._act(step, name, reason)
            share = min(share, part)
        for arm, motion in zip(self._arms, asked, strict=True):
            for name, times, reason in self._task.excess(motion):
                self._act(step, name, f"{arm}{reason}")
                share = min(share, _RESERVE / times)
        part, joint = self._joints.arrival(displacement, step.goal_velocity, step.duration_s)
        if part < share:
            self._act(
                step,
                "acceleration",
                f"{joint} could not stop at its goal: it would be too fast for its acceleration.",
            )
            share = part
        velocity, joint = self._joints.nearest_velocity(
            step.before, displacement * (share / step.duration_s), step.passed_s
        )
        if joint:
            self._act(
                step,
                "acceleration",
                f"{joint} would change its velocity faster than its acceleration allows.",
            )
        if step.acted:
            step.target = step.start + velocity * step.duration_s

    def _apply_cartesian_limits(
        self, step: Step, measured: tuple[Pose, ...], target: Posture
    ) -> Posture:
        """Scale the step to the Cartesian limits, to 1/64 of its length; returns the posture at its
        end.
        """
        violations = list(self._cartesian_violations(step, measured, target))
        if not violations:
            return target
        for name, reason in violations:
            self._act(step, name, reason)
        good, bad, displacement = 0.0, 1.0, step.target - step.start
        for _ in range(_HALVINGS):
            middle = (good + bad) / 2.0
            step.target = step.start + middle * displacement
            end = self._evaluate(step, step.target)
            if next(self._cartesian_violations(step, measured, end), None) is None:
                good = middle
            else:
                bad = middle
        step.target = step.start + good * displacement
        return self._evaluate(step, step.target)

    def _cartesian_violations(
        self, step: Step, measured: tuple[Pose, ...], target: Posture
    ) -> Iterator[tuple[str, str]]:
        """Cartesian limits that the path from the measured posture to the step's target violates:
        name, reason.
        """

        def evaluate_start(number: int = 0) -> Posture:
            return self._evaluate(step, step.measured).arms[number]

        for number, (pose, end) in enumerate(zip(measured, target.arms, strict=True)):
            for name, reason in self._task.places(pose, end, partial(evaluate_start, number)):
                yield name, reason if name == "collision" else f"{self._arms[number]}{reason}"
        if not self._checks_path:
            return
        displacement = step.target - step.measured
        count = self._reach.count(self._names, np.abs(displacement))
        for number in range(1, count):
            passed = self._evaluate(step, step.measured + displacement * (number / count))
            for violation in self._task.collisions(passed, evaluate_start):
                yield violation
                return

    def _act(self, step: Step, name: str, reason: str) -> None:
        """Record a violated limit; raises _Rejection unless its reaction is to scale."""
        reaction = self._rules.reactions[name]
        if reaction != "scale":
            raise _Rejection(name, reason, refuse=reaction == "refuse")
        step.acted.append(name)
        step.reason = reason

    def _motions(
        self, step: Step, measured: tuple[Pose, ...], start: tuple[Pose, ...], target: Posture
    ) -> list[Motion]:
        """The step in numbers, for each arm, as limits and status tell it; the speed of the joints
        is that of all of them.

        Args:
            step: as it is now.
            measured, start: TCPs where the arms are measured, and at the setpoint.
            target: posture at the step's target.
        """
        speed = float(np.abs(step.target - step.start).max(initial=0.0)) / step.duration_s
        return [
            self._task.motion(pose, before, end, step.duration_s, speed)
            for pose, before, end in zip(measured, start, target.arms, strict=True)
        ]

    def _evaluate(self, step: Step, position: F64) -> Posture:
        posture = self._inspect(self._sample(step, position))
        if len(posture.arms) != len(self._arms):
            raise UnsafeError(
                f"The controller tells the postures of {len(posture.arms)} arms, the robot has "
                f"{len(self._arms)}."
            )
        return posture

    def _sample(self, step: Step, position: F64) -> JointSample:
        """A posture for the controller: the arm at `position`, all other joints as `step.others`
        says, because the fingers count for collisions too.
        """
        names, others = step.others
        if names:
            names, position = (*self._names, *names), np.concatenate([position, others])
        return JointSample(names=names or self._names, position=position, stamp_ns=step.stamp_ns)

    def _command(self, command: JointCommand, step: Step) -> JointCommand:
        """What is sent: the command itself, or a copy whose arm joints end where the step does; the
        gripper goes where it was commanded to.
        """
        if not step.acted and step.duration_s == command.duration_s:
            return command
        position = command.position.copy()
        position[[command.names.index(name) for name in self._names]] = step.target
        return replace(command, position=position, duration_s=step.duration_s)
