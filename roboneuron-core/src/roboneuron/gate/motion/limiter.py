"""Every limit on one command of control, in order; the answer says what to send and which limits acted."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import Hold, JointCommand, JointSample, Pose, Posture, RobotProfile
from roboneuron.contract.profile import prismatic_joints
from roboneuron.errors import UnsafeError
from roboneuron.gate.motion.joint_space import JointSpace
from roboneuron.gate.motion.reach import Reach
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.gate.motion.selection import check_gripper, pick, pick_others
from roboneuron.gate.motion.setpoint import CommandedMotion
from roboneuron.gate.motion.task_space import TaskSpace
from roboneuron.gate.motion.verdict import Motion, Verdict

F64 = NDArray[np.float64]

LOST, LOST_M = 0.1, 0.02
"""Farther [rad; m of slides] than this from where the commands should have brought it, the arm does not follow them."""
_MEMORY_S = 1.0
"""After so long without a command the arm rests, and is met where it is measured."""
_SHORTEST_S = 1e-3
_HALVINGS = 6
"""How finely the share of a step is sought that stays out of a zone: to 1/64."""


class _Stop(Exception):
    """A limit ends the command: its reaction is "hold" or "refuse", or no part of the command is within the limits."""

    def __init__(self, name: str, reason: str, *, refuse: bool = False) -> None:
        super().__init__(reason)
        self.name, self.reason, self.refuse = name, reason, refuse


@dataclass(kw_only=True, slots=True, eq=False)
class _Step:
    """What one command is judged by; arrays are float64 (n,) in the order of the profile's arm joints.

    `others` are names and positions of joints beside the arm's, as commanded or else as measured.
    """

    measured: F64
    start: F64
    before: F64
    asked: F64
    duration_s: float
    passed_s: float
    stamp_ns: int
    others: tuple[tuple[str, ...], F64]
    acted: list[str] = field(default_factory=list)
    reason: str = ""


class MotionLimiter:
    """Limits successive commands of one arm; keeps where they should have brought it. Used from one thread.

    A command leaves `limit` as asked, shortened ("scale"), as a reason to hold, or not at all ("refuse"). Shortening
    keeps the direction through joint space from where the arm was commanded so far; only an arm that is too fast to
    turn or stop at once first changes its velocity towards the asked one. What cannot be judged is a reason to hold.

    Args:
        rules: numbers and reactions.
        profile: joints, limits and gripper of the robot.
        forward: TCP pose of a posture; raises UnsafeError.
        inspect: the same with all that `Posture` holds; raises likewise.
        immediate: commands carry no time, so that the robot may jump to them (JointState commands).
    """

    def __init__(
        self,
        rules: MotionRules,
        profile: RobotProfile,
        forward: Callable[[JointSample], Pose],
        inspect: Callable[[JointSample], Posture],
        *,
        immediate: bool = False,
    ) -> None:
        self._rules = rules
        self._names = profile.arm_joints
        self._gripper = profile.gripper
        self._joints = JointSpace(
            profile.limits,
            len(profile.arm_joints),
            velocity=rules.velocity_fraction,
            acceleration=rules.acceleration_fraction,
        )
        self._task = TaskSpace(rules)
        self._reach = Reach(profile)
        slides = prismatic_joints(profile.urdf)
        self._lost = np.array([LOST_M if name in slides else LOST for name in profile.arm_joints])
        self._checks_way = profile.collision is not None
        self._forward, self._inspect = forward, inspect
        self._immediate = immediate
        self._commanded = CommandedMotion(immediate=immediate)

    def limit(self, command: JointCommand, joints: JointSample, now_s: float) -> Verdict:
        """Judge a command that is to be sent now.

        Args:
            command: of the controller; `duration_s` is the time until the next one is expected, or longer.
            joints: newest measured joints.
            now_s: monotonic time.
        """
        step: _Step | None = None
        asked: Motion | None = None
        lost = False
        try:
            check_gripper(command, self._names, self._gripper)
            step, lost = self._step(command, joints, now_s)
            here = start = self._forward(self._sample(step, step.measured))
            if step.start is not step.measured:
                start = self._forward(self._sample(step, step.start))
            there = self._look(step, step.asked)
            asked = self._motion(step, here, start, there, step.asked)
            target = self._pace(step, asked)
            if step.acted:
                there = self._look(step, target)
            target, there = self._place(step, here, target, there)
            sent = self._motion(step, here, start, there, target) if step.acted else asked
            self._check(step, here, there, sent, target)
        except UnsafeError as error:
            hold = Hold(code="unsafe_command", reason=str(error))
            return Verdict(command=hold, reason=str(error), share=0.0, asked=asked, reference_lost=lost)
        except _Stop as stop:
            assert step is not None
            acted = tuple(dict.fromkeys((*step.acted, stop.name)))
            outcome = None if stop.refuse else Hold(code=f"limit_{stop.name}", reason=stop.reason)
            return Verdict(
                command=outcome, acted=acted, reason=stop.reason, share=0.0, asked=asked, reference_lost=lost
            )
        way, wanted = target - step.start, step.asked - step.start
        self._commanded.go(step.start, way, step.duration_s, now_s)
        length = float(np.linalg.norm(wanted))
        return Verdict(
            command=self._command(command, target, step),
            acted=tuple(dict.fromkeys(step.acted)),
            reason=step.reason,
            share=float(np.linalg.norm(way)) / length if step.acted and length > 0.0 else 1.0,
            asked=asked,
            sent=sent,
            reference_lost=lost,
        )

    def follow(self, command: JointCommand, joints: JointSample, sent_s: float) -> None:
        """Somebody else has sent this command, at the monotonic time `sent_s`: it is the reference for the next one.

        One that cannot be understood leaves no reference, so that the arm is met where it is measured.
        """
        try:
            step, _ = self._step(command, joints, sent_s)
        except UnsafeError:
            self._commanded.forget()
        else:
            self._commanded.go(step.start, step.asked - step.start, step.duration_s, sent_s)

    def rest(self, joints: JointSample | None, now_s: float) -> None:
        """The arm was told to hold where it is measured; None: nobody knows where it is."""
        try:
            if joints is not None:
                self._commanded.rest(pick(joints.names, joints.position, self._names), now_s)
                return
        except UnsafeError:
            pass
        self._commanded.forget()

    def _step(self, command: JointCommand, joints: JointSample, now_s: float) -> tuple[_Step, bool]:
        measured = pick(joints.names, joints.position, self._names)
        asked = pick(command.names, command.position, self._names)
        if not (math.isfinite(command.duration_s) and command.duration_s > 0.0):
            raise UnsafeError(f"A command lasts {command.duration_s} s, expected a finite time > 0.")
        since_s = self._commanded.passed_s(now_s)
        commanded = self._commanded.at(now_s) if since_s < _MEMORY_S else None
        lost = commanded is not None and bool((np.abs(commanded[0] - measured) > self._lost).any())
        start, before = (measured, np.zeros_like(measured)) if commanded is None or lost else commanded
        duration_s = max(_SHORTEST_S, min(command.duration_s, since_s) if self._immediate else command.duration_s)
        step = _Step(
            measured=measured,
            start=start,
            before=before,
            asked=asked,
            duration_s=duration_s,
            passed_s=max(0.0, min(since_s, duration_s)),
            stamp_ns=joints.stamp_ns,
            others=pick_others(command, joints, self._names),
        )
        return step, lost

    def _look(self, step: _Step, position: F64) -> Posture:
        return self._inspect(self._sample(step, position))

    def _sample(self, step: _Step, position: F64) -> JointSample:
        names, others = step.others
        if not names:
            return JointSample(names=self._names, position=position, stamp_ns=step.stamp_ns)
        return JointSample(
            names=(*self._names, *names), position=np.concatenate([position, others]), stamp_ns=step.stamp_ns
        )

    def _broken(self, step: _Step, here: Pose, target: F64, there: Posture) -> Iterator[tuple[str, str]]:
        def look_here() -> Posture:
            return self._look(step, step.measured)

        yield from self._task.places(here, there, look_here)
        if not self._checks_way:
            return
        way = target - step.measured
        count = self._reach.count(self._names, np.abs(way))
        for number in range(1, count):
            passed = self._look(step, step.measured + way * (number / count))
            for reason in self._task.collisions(passed, look_here):
                yield "collision", reason
                return

    def _motion(self, step: _Step, here: Pose, start: Pose, there: Posture, target: F64) -> Motion:
        speed = float(np.abs(target - step.start).max(initial=0.0)) / step.duration_s
        return self._task.motion(here, start, there, step.duration_s, speed)

    def _act(self, step: _Step, name: str, reason: str) -> None:
        """Note that a limit is broken; raises _Stop unless its reaction is to scale."""
        reaction = self._rules.reactions[name]
        if reaction != "scale":
            raise _Stop(name, reason, refuse=reaction == "refuse")
        step.acted.append(name)
        step.reason = reason

    def _pace(self, step: _Step, asked: Motion) -> F64:
        """The farthest posture on the way to the asked one that the limits of joints, step and speed allow."""
        way = step.asked - step.start
        share, joint = self._joints.position_share(step.start, way)
        if joint >= 0:
            self._act(step, "position", f"{self._names[joint]} would go to {step.asked[joint]:.4f}, beyond its limits.")
        slower, joint = self._joints.velocity_share(step.start, way, step.duration_s)
        if joint >= 0:
            speed = abs(way[joint]) / step.duration_s
            self._act(
                step,
                "velocity",
                f"{self._names[joint]} would move at {speed:.4g} per second, allowed is {speed * slower:.4g}.",
            )
        share = min(share, slower)
        for name, part, reason in self._task.pace(asked):
            self._act(step, name, reason)
            share = min(share, part)
        velocity, joint = self._joints.reach(step.before, way * (share / step.duration_s), step.passed_s)
        if joint >= 0:
            name = self._names[joint]
            self._act(step, "acceleration", f"{name} would change its velocity faster than its acceleration allows.")
        return step.start + velocity * step.duration_s if step.acted else step.asked

    def _place(self, step: _Step, here: Pose, target: F64, there: Posture) -> tuple[F64, Posture]:
        """The farthest posture on the way to `target` that is nowhere the arm must not be, within 1/64 of the way."""
        broken = list(self._broken(step, here, target, there))
        if not broken:
            return target, there
        for name, reason in broken:
            self._act(step, name, reason)
        good, bad = 0.0, 1.0
        best, way = step.start, target - step.start
        for _ in range(_HALVINGS):
            middle = (good + bad) / 2.0
            position = step.start + middle * way
            if next(self._broken(step, here, position, self._look(step, position)), None) is None:
                good, best = middle, position
            else:
                bad = middle
        return best, self._look(step, best)

    def _check(self, step: _Step, here: Pose, there: Posture, sent: Motion, target: F64) -> None:
        """Once more, on what would be sent: shortening for one limit may break another one. Raises _Stop."""
        if not step.acted:
            return
        way = target - step.start
        for name, (share, joint) in (
            ("position", self._joints.position_share(step.start, way)),
            ("velocity", self._joints.velocity_share(step.start, way, step.duration_s)),
        ):
            if share < 1.0 and joint >= 0:
                raise _Stop(name, f"No part of the command keeps {self._names[joint]} within its {name}.")
        if not self._joints.is_reachable(step.before, way / step.duration_s, step.passed_s):
            raise _Stop("acceleration", f"The arm is too fast for a limit before it: {step.reason}")
        for name, _, reason in self._task.pace(sent):
            raise _Stop(name, reason)
        for name, reason in self._broken(step, here, target, there):
            raise _Stop(name, reason)

    def _command(self, command: JointCommand, target: F64, step: _Step) -> JointCommand:
        if not step.acted and step.duration_s == command.duration_s:
            return command
        position = np.array(command.position, dtype=np.float64)
        position[[command.names.index(name) for name in self._names]] = target
        return replace(command, position=position, duration_s=step.duration_s)
