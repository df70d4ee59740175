"""Tool move_joints: joint targets of an arm, sent as one trajectory point within the limits and
monitored until arrival.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic.json_schema import JsonSchemaValue

from roboneuron.contract import JointSample
from roboneuron.direct_path.delivery import TRAJECTORY
from roboneuron.direct_path.derived import Derived
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, StateError
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.path_watch import SILENCE_S
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate, TimedCommand
from roboneuron.server.rehearsal import Needs, Rehearsal
from roboneuron.server.tool import CallContext, Tool
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.arm.grip import Grip, is_lost
from roboneuron.tools.arm.joint_goals import (
    JointMove,
    MoveJoints,
    easy_s,
    nearest_goals,
    schema_of,
    trajectory_to,
)
from roboneuron.tools.arm.joint_rest import JointRest, position_of
from roboneuron.tools.arm.progress import MotionProgress

_EASIER = 1.04
"""Reserve under a limit that a move without a given duration would exceed: an arm is measured a
little faster than its path is planned.
"""
_LOOK_S, _SETTLE_S = 0.02, 3.0
"""Period of the measurements of a motion, and how long after its duration it may come no nearer."""
_MEASURED_S = 2.0
"""Longest wait for a measurement, and for the robot's subscription."""


def joint_tools(host: Host, endpoints: Iterable[ExposedEndpoint], gate: MotionGate) -> list[Tool]:
    """Create move_joints for the first endpoint that accepts trajectories of a robot with known
    limits.
    """
    found = next(
        (e for e in endpoints if e.endpoint.joint_limited and e.endpoint.type == TRAJECTORY), None
    )
    if found is None or found.profile is None:
        return []
    limits = joint_space.JointLimit.by_joint(found.profile)
    mover = JointMover(found, limits, gate, host)
    joints: JsonSchemaValue = {
        "properties": {name: schema_of(limit) for name, limit in limits.items()},
        "additionalProperties": False,
    }
    return [
        Tool(
            name="move_joints",
            title="Move joints",
            description=(
                f"Move joints of {found.robot!r} to positions [rad, m], within their limits. "
                "Needs start_robot; refused while a policy has an instruction. Returns when they "
                "are measured there, at rest."
            ),
            arguments=Derived(
                model=MoveJoints,
                properties={
                    "positions": joints,
                    "duration_s": {"maximum": gate.max_duration_s},
                },
                required=["positions"],
            ),
            result=JointMove,
            handler=mover,
            open_world=True,
            simulated_by=frozenset({"twin", "limits"}),
        )
    ]


class JointMover:
    """The handler of move_joints; follows `Rehearsable`."""

    rehearsal_needs: Needs = frozenset()

    def __init__(
        self,
        exposed: ExposedEndpoint,
        limits: Mapping[str, joint_space.JointLimit],
        gate: MotionGate,
        host: Host,
    ) -> None:
        self.exposed = self._exposed = exposed
        self._limits = limits
        self._gate = gate
        self._host = host
        self._clock = host.clock(exposed.namespace)
        assert exposed.profile is not None
        self._profile = exposed.profile
        # by joint: the hand of its arm
        self._grip_of: dict[str, Grip] = {}
        for arm in exposed.profile.each_arm:
            grip = Grip(host, gate, exposed, arm.name)
            fingers = () if arm.gripper is None else (arm.gripper.joint,)
            self._grip_of |= dict.fromkeys((*arm.joints, *fingers), grip)

    async def __call__(self, arguments: MoveJoints, context: CallContext) -> JointMove:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        self.check(arguments)
        halt = threading.Event()
        return await context.run(
            lambda stage: self._move(arguments, context, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

    def check(self, arguments: MoveJoints) -> None:
        """Raise InvalidInputError unless the joints have these positions, RefusedError for the
        joint of a gripper that is not there.
        """
        for name, value in arguments.positions.items():
            if name not in self._limits:
                raise InvalidInputError.unknown_name("positions", name, list(self._limits))
            limit = self._limits[name]
            gripper = self._grip_of[name].profile if name in self._grip_of else None
            if gripper is not None and gripper.joint == name:
                self._grip_of[name].check_fitted()
            if not limit.lower <= value <= limit.upper:
                raise InvalidInputError(
                    f"positions.{name} is {value:g}, expected from {limit.lower:g} to "
                    f"{limit.upper:g}.",
                    path=f"positions.{name}",
                )

    def _move(
        self, arguments: MoveJoints, context: CallContext, stage: Stage, halt: threading.Event
    ) -> JointMove:
        exposed, gate = self._exposed, self._gate
        simulated = context.simulated
        if not simulated:
            self._clock.await_rest()
        joints = gate.joints(exposed, _MEASURED_S)
        if joints is None:
            raise self._unmeasured()
        target = nearest_goals(arguments.positions, joints, self._limits)
        request, duration_s = self.request(arguments, joints, context)
        if simulated:
            verdict = gate.ask(exposed, request)
            return self._answer(target, joints, duration_s, verdict.allowed, verdict.reason, True)
        grips = list(dict.fromkeys(self._grip_of[name] for name in target))
        before = [(grip.commanded(), grip.holding()) for grip in grips]
        commands = self._commands(target, request.messages[0], duration_s, stage)
        sent = gate.play(
            exposed, request, commands, total_s=duration_s, timeout_s=_MEASURED_S, halt=halt
        )
        if not sent.verdict.may_send:
            return self._answer(
                target, joints, 0.0, sent.verdict.allowed, sent.verdict.reason, True
            )
        answer = self._answer(
            target, gate.newest_joints(exposed) or joints, sent.duration_s, True, "", False
        )
        hands = {grip.arm: grip.holding() for grip in grips}
        lost = any(
            is_lost(held, hands[grip.arm], _asked_opening(grip, target), kept)
            for grip, (kept, held) in zip(grips, before, strict=True)
        )
        told: dict[str, object] = {"holding": _any(hands.values()), "lost_on_the_way": lost}
        if exposed.profile is not None and exposed.profile.arms:
            told["hands"] = hands
        return answer.model_copy(update=told)

    def request(
        self, arguments: MoveJoints, joints: JointSample, context: CallContext
    ) -> tuple[GateRequest, float]:
        """What the gate is asked for a call that begins at `joints`, and how long it lasts [s].
        Raises RefusedError, NotReadyError.
        """
        target, asked_s = (
            nearest_goals(arguments.positions, joints, self._limits),
            arguments.duration_s,
        )
        in_force = {**self._limits, **self._gate.joint_limits(self._exposed)}
        duration_s = asked_s or easy_s(target, joints, in_force)
        request = GateRequest.of(
            context,
            "move_joints",
            self._exposed,
            [trajectory_to(target, duration_s, joints, self._limits)],
            arguments.given(),
            joints=joints,
        )
        if asked_s is None and (slower := self._gate.slowdown(request)) > 1.0:
            duration_s *= slower * _EASIER
            request = replace(
                request, messages=(trajectory_to(target, duration_s, joints, self._limits),)
            )
        return request, duration_s

    def rehearse(self, arguments: MoveJoints, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`."""
        self.check(arguments)
        joints = rehearsal.arm.joints()
        request, _ = self.request(arguments, joints, rehearsal.context)
        rehearsal.play(request.messages)

    def check_path(
        self,
        steps: Sequence[Mapping[str, float]],
        context: CallContext,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        """Raise RefusedError unless calls with these positions, one after the other from where the
        arm stands now, would be allowed; blocks, and moves nothing. A rehearsal judges from where
        its arm stands.

        Raises:
            InvalidInputError: a joint does not have such a position.
            NotReadyError: the joints are not measured.
        """
        for positions in steps:
            self.check(MoveJoints(positions=dict(positions)))
        if rehearsal is not None:
            planned = self.path_request(steps, rehearsal.arm.joints(), context)
            rehearsal.check(planned.messages)
            return
        joints = self._gate.joints(self._exposed, _MEASURED_S)
        if joints is None:
            raise self._unmeasured()
        request = replace(self.path_request(steps, joints, context), simulated=True)
        verdict = self._gate.ask(self._exposed, request)
        if not verdict.allowed:
            raise RefusedError(f"Nothing has moved. {verdict.reason}", rule=verdict.rule)

    def path_request(
        self, steps: Sequence[Mapping[str, float]], joints: JointSample, context: CallContext
    ) -> GateRequest:
        """What the gate is asked for such calls together, from `joints` on. Raises as `request`."""
        messages: list[object] = []
        send_at_s, at_s, begin = list[float](), 0.0, joints
        for positions in steps:
            move = MoveJoints(positions=dict(positions))
            part, duration_s = self.request(move, joints, context)
            messages += part.messages
            send_at_s.append(at_s)
            at_s += duration_s
            there = nearest_goals(positions, joints, self._limits)
            position = [
                there.get(name, at)
                for name, at in zip(joints.names, joints.position.tolist(), strict=True)
            ]
            joints = JointSample(names=joints.names, position=np.array(position))
        return replace(part, messages=tuple(messages), send_at_s=tuple(send_at_s), joints=begin)

    def _unmeasured(self) -> NotReadyError:
        """Create the error for missing joints: the robot is not running, or its states do not
        arrive.
        """
        robot = self._host.modules.view("robot")
        if robot.phase != "running" or self._exposed.namespace != self._host.config.namespace:
            return NotReadyError("The joints are not measured.", hint="Call start_robot first.")
        return NotReadyError(
            f"The robot runs, but no joint state came within {_MEASURED_S:g} s; nothing was sent.",
            hint="The machine may be overloaded: see get_status, and call again.",
        )

    def _is_there(self, target: Mapping[str, float], joints: JointSample) -> bool:
        profile = self._profile
        left = self._left(target, joints)
        return all(
            abs(profile.kinds.difference(name, position_of(joints, name), value))
            < profile.tolerance(name)
            for name, value in left.items()
        )

    def _error(self, target: Mapping[str, float], joints: JointSample) -> float:
        return max(self._off_by(target, joints).values(), default=0.0)

    def _off_by(self, target: Mapping[str, float], joints: JointSample) -> dict[str, float]:
        """Distance from the target by joint [rad or m]."""
        difference = self._profile.kinds.difference
        return {n: abs(difference(n, position_of(joints, n), v)) for n, v in target.items()}

    def _left(self, target: Mapping[str, float], joints: JointSample) -> Mapping[str, float]:
        """Remaining targets, without those of grippers that an object keeps from closing, since
        these grasp.
        """
        left = dict(target)
        for gripper in {self._grip_of[name].profile for name in target}:
            if gripper is None or gripper.joint not in target:
                continue
            asked, measured = target[gripper.joint], position_of(joints, gripper.joint)
            # `to_opening` would take an infinite position for an object in the hand
            if math.isfinite(measured) and gripper.to_opening(measured) > gripper.to_opening(asked):
                del left[gripper.joint]
        return left

    def _commands(
        self, target: Mapping[str, float], message: object, duration_s: float, stage: Stage
    ) -> Iterator[TimedCommand]:
        """Yield the trajectory, then wait until the arm is measured at its end, at rest.

        Raises:
            StateError: the joints are no longer measured, or do not arrive.
        """
        waiting = self._clock.play_to_rest(message, lambda: self._gate.newest_joints(self._exposed))
        if waiting is not None:
            at_rest = yield from waiting
            if not self._is_there(target, at_rest):
                raise self._off(target, at_rest)
            return
        began_s = told_s = seen_s = time.monotonic()
        rest = JointRest(target, self._profile.kinds)
        progress = MotionProgress(duration_s, self._gate.max_duration_s, _SETTLE_S)
        yield TimedCommand(message=message, due_s=began_s)
        while True:
            now_s = time.monotonic()
            joints = self._gate.newest_joints(self._exposed)
            if joints is None:
                if now_s - seen_s > SILENCE_S:
                    raise StateError(
                        "The joints are not measured any more.", hint="See get_status."
                    )
                yield TimedCommand(message=None, due_s=now_s + _LOOK_S)
                continue
            seen_s = now_s
            rests = rest.note(joints, now_s)
            is_there = self._is_there(target, joints)
            if is_there and rests and now_s - began_s >= duration_s * 0.9:
                return
            if progress.is_stuck(self._error(target, joints), now_s - began_s):
                if is_there:  # within the tolerance, but never at rest: an oscillating joint
                    return
                raise self._off(target, joints)
            if now_s - told_s >= 0.5:
                told_s = now_s
                stage(
                    f"{now_s - began_s:.1f} of {duration_s:.1f} s, "
                    f"{self._error(target, joints):.3f} to go"
                )
            yield TimedCommand(message=None, due_s=now_s + _LOOK_S)

    def _off(self, target: Mapping[str, float], joints: JointSample) -> StateError:
        off = ", ".join(f"{n} {v:.4f}" for n, v in self._off_by(target, joints).items())
        return StateError(
            f"The joints do not come nearer to the target; they are off by {off} [rad or m]."
        )

    def _answer(
        self,
        target: Mapping[str, float],
        joints: JointSample,
        duration_s: float,
        allowed: bool,
        reason: str,
        simulated: bool,
    ) -> JointMove:
        return JointMove(
            robot=self._exposed.robot,
            position={name: round(position_of(joints, name), 5) for name in target},
            error=round(self._error(self._left(target, joints), joints), 5),
            duration_s=round(duration_s, 3),
            simulated=simulated,
            allowed=allowed,
            reason=reason,
        )


def _asked_opening(grip: Grip, target: Mapping[str, float]) -> float | None:
    """Opening that targets command for a gripper; None if they do not name it."""
    gripper = grip.profile
    if gripper is None or gripper.joint not in target:
        return None
    return gripper.to_opening(target[gripper.joint])


def _any(held: Iterable[bool | None]) -> bool | None:
    """True if one of several hands holds an object; None if unknown."""
    told = list(held)
    return True if True in told else None if None in told else False
