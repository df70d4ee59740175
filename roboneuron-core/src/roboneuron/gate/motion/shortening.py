"""Shortening of a command to within the limits, or its rejection."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice

import numpy as np

from roboneuron.contract import F64, STATE_STEP_S, JointSample, Pose, Posture, RobotProfile
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.acceleration import JointAccelerations
from roboneuron.gate.motion.command import Step
from roboneuron.gate.motion.joint_space import JointLimit, JointSpace
from roboneuron.gate.motion.path import Reach, postures
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.gate.motion.task_space import Motion, PlaceViolation, TaskSpace, largest

_HALVINGS = 6
"""Bisections when a step is shortened to avoid a zone: to 1/64 of the step."""
_RESERVE = 0.98
"""Fraction of a Cartesian limit used when a step is scaled: a straight line in joint space is a
curve in task space.
"""


class Rejection(Exception):
    """The limits reject the command: the reaction is "hold" or "refuse", or no scaled command is
    within the limits.
    """

    def __init__(self, name: str, reason: str, *, refuse: bool = False) -> None:
        super().__init__(reason)
        self.name, self.refuse = name, refuse


def _ratio(of_all: float, of_step: float) -> float:
    """Ratio of the whole path's length to the step's; 1 without a step."""
    return of_all / of_step if of_step > 0.0 else 1.0


class Shortener:
    """Apply the limits to one step. Used from one thread.

    Args:
        rules: numbers and reactions.
        profile: joints, limits and gripper of the robot.
        poses: TCP pose of each arm; raises UnsafeError.
        inspect: returns the posture; raises UnsafeError.
        immediate: commands carry no time.
        longest_s: longest duration of a command.

    Attributes:
        limits: of each joint with limits, by name.
        accelerations: limits of the arm joints' accelerations.
    """

    def __init__(
        self,
        rules: MotionRules,
        profile: RobotProfile,
        poses: Callable[[JointSample], tuple[Pose, ...]],
        inspect: Callable[[JointSample], Posture],
        *,
        immediate: bool,
        longest_s: float,
    ) -> None:
        self._profile = profile
        self._names = profile.arm_joints
        self.use(rules)
        self._reach = Reach(profile)
        self._poses, self._inspect = poses, inspect
        self._arms = [f"{arm.name}: " if arm.name else "" for arm in profile.each_arm]
        self._immediate, self._longest_s = immediate, longest_s

    def use(self, rules: MotionRules) -> None:
        """Apply other rules from the next step on."""
        self._rules = rules
        self.limits = JointLimit.by_joint(self._profile, rules)
        limits = [self.limits.get(name, JointLimit()) for name in self._names]
        self._joints = JointSpace(self._names, limits)
        self.accelerations = JointAccelerations(self._names, limits)
        self._task = TaskSpace(rules)

    def shorten(self, step: Step) -> Motion:
        """Scale the step's target to within the limits; return the motion that is sent, raise
        Rejection.
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
            # Check the result once more: scaling for one limit may violate another one.
            sent = largest(self._motions(step, measured, start, target))
            displacement = step.target - step.start
            for name, _, reason in self._joints.violations(
                step.start, displacement, step.duration_s
            ):
                raise Rejection(name, f"No part of the command is within the limits: {reason}")
            if not self.accelerations.is_reachable(
                step.before, displacement / step.duration_s, step.passed_s
            ):
                raise Rejection(
                    "acceleration", f"The arm is too fast for a limit before it: {step.reason}"
                )
            for name, _, reason in self._task.excess(sent):
                raise Rejection(name, reason)
            for name, reason, _ in self._cartesian_violations(step, measured, target):
                raise Rejection(name, reason)
        if self._extend(step, measured, target):
            sent = largest(self._motions(step, measured, start, target))
        return sent

    def _extend(self, step: Step, measured: tuple[Pose, ...], target: Posture) -> bool:
        """Extend the command to the time that the TCP needs from its measured pose; return True if
        it was extended.

        The speed limit is applied from the setpoint. An arm that was delayed (a late command, a
        frozen driver) is behind the setpoint and would catch up within the command's time.
        """
        if self._immediate:
            return False
        times = self._speed_ratio(measured, target, step.duration_s)
        if times <= 1.0:
            return False
        displacement, least_s = step.target - step.start, step.duration_s
        most_s = min(least_s * times / _RESERVE, self._longest_s)
        if not self.accelerations.is_reachable(step.before, displacement / most_s, step.passed_s):
            for _ in range(_HALVINGS):  # it brakes no harder than the joints may
                middle_s = (least_s + most_s) / 2.0
                if self.accelerations.is_reachable(
                    step.before, displacement / middle_s, step.passed_s
                ):
                    least_s = middle_s
                else:
                    most_s = middle_s
            most_s = least_s
        step.duration_s = most_s
        return True

    def _speed_ratio(self, measured: tuple[Pose, ...], target: Posture, duration_s: float) -> float:
        """Ratio of a TCP's speed on its path from the measured pose to the speed limit."""
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
            # The arm has to cover its lag and the step. Only the step can be scaled: (behind +
            # share * step) / (behind + step) = _RESERVE / times, solved for share, with whole /
            # step = `parts`; once for distances, once for rotations.
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
        part, joint = self.accelerations.arrival(displacement, step.goal_velocity, step.duration_s)
        if part < share:
            self._act(
                step,
                "acceleration",
                f"{joint} could not stop at its goal: it would be too fast for its acceleration.",
            )
            share = part
        velocity, joint = self.accelerations.nearest_velocity(
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
        """Scale the step to the Cartesian limits, down to 1/64 of its length; return the posture at
        its end.
        """
        violations = list(self._cartesian_violations(step, measured, target))
        if not violations:
            return target
        for found in violations:
            self._act(step, found.limit, found.reason)
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
    ) -> Iterator[PlaceViolation]:
        """Cartesian limits that the path from the measured posture to a step's target violates."""

        def evaluate_start(number: int = 0) -> Posture:
            return self._evaluate(step, step.measured).arms[number]

        for number, (pose, end) in enumerate(zip(measured, target.arms, strict=True)):
            for found in self._task.places(pose, end, partial(evaluate_start, number)):
                arm = "" if found.limit == "collision" else self._arms[number]
                yield found._replace(reason=f"{arm}{found.reason}")
        if self._profile.collision is None and not self._task.judges_links:
            return
        displacement = step.target - step.measured
        count = self._reach.count(self._names, np.abs(displacement))
        # without the last one, the target, which was judged above
        for position in islice(postures(step.measured, displacement, count), count - 1):
            passed = self._evaluate(step, position)
            for violation in self._task.links(passed, evaluate_start):
                yield violation
                return

    def _act(self, step: Step, name: str, reason: str) -> None:
        """Record a violated limit; raise Rejection unless its reaction is to scale."""
        reaction = self._rules.reactions[name]
        if reaction != "scale":
            raise Rejection(name, reason, refuse=reaction == "refuse")
        step.acted.append(name)
        step.reason = reason

    def _motions(
        self, step: Step, measured: tuple[Pose, ...], start: tuple[Pose, ...], target: Posture
    ) -> list[Motion]:
        """Return the properties of the step for each arm, for limits and status; the joint speed is
        the maximum of all arms.

        Args:
            step: in its present state.
            measured, start: TCPs at the measured joints, and at the setpoint.
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
        """Create a posture for the controller: the arm at `position`, all other joints as in
        `step.others`, because the fingers count for collisions too.
        """
        names, others = step.others
        if names:
            names, position = (*self._names, *names), np.concatenate([position, others])
        return JointSample(names=names or self._names, position=position, stamp_ns=step.stamp_ns)
