"""move_joints: joint targets of an arm, as one trajectory point within the limits, followed until the arm is there."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from pydantic import Field

from rn_direct_path.delivery import TRAJECTORY, Command
from rn_direct_path.derived import Derived
from rn_direct_path.exposed import Exposed, gate_request
from rn_direct_path.motion_gate import MotionGate
from rn_direct_path.speeds import shortest_s
from roboneuron.contract import JointSample
from roboneuron.errors import InvalidInputError, NotReadyError, StateError
from roboneuron.gate.motion.joint_space import JointLimit, joint_limits
from roboneuron.server.schema import Schema, unknown_name
from roboneuron.server.tool import Arguments, CallContext, Result, Stage, Tool

_EASY, _EASY_ACCELERATION = 0.4, 0.5
"""Shares of the velocity and acceleration limits that a move uses when it is given no duration."""
_NEARLY = 0.95
"""Share of what a joint may do so near to its limit."""
_SETTLE_S = 3.0
_MEASURED_S = 2.0
"""Longest wait for a measurement, and for the robot to subscribe."""


class MoveJoints(Arguments):
    """Arguments of move_joints."""

    positions: dict[str, float] = Field(
        min_length=1, description="Target by joint, rad or m; the others stay where they are."
    )
    duration_s: float | None = Field(
        default=None, gt=0, description="Time for the move [s]; an easy pace when omitted."
    )
    dry_run: bool = Field(default=False, description="Only answer what would happen; nothing is sent.")


class JointMove(Result):
    """What the arm did, measured."""

    robot: str
    position: dict[str, float] = Field(description="measured at the end [rad or m]")
    error: float = Field(description="largest distance from the target [rad or m]")
    duration_s: float
    dry_run: bool
    allowed: bool
    reason: str


def joint_tools(endpoints: Iterable[Exposed], gate: MotionGate) -> list[Tool[Any]]:
    """move_joints for the first endpoint that takes trajectories of a robot with known limits."""
    found = next((e for e in endpoints if e.endpoint.joint_limited and e.endpoint.type == TRAJECTORY), None)
    if found is None or found.profile is None:
        return []
    limits = joint_limits(found.profile)
    mover = _JointMover(found, limits, gate)
    joints: Schema = {
        "properties": {
            name: {"type": "number", "minimum": limit.lower, "maximum": limit.upper} for name, limit in limits.items()
        },
        "additionalProperties": False,
    }
    return [
        Tool(
            name="move_joints",
            title="Move joints",
            description=(
                f"Move joints of {found.robot!r} to positions [rad, m], within their position and velocity limits. "
                "Needs start_robot; refused while a policy runs. Returns when they are measured there."
            ),
            arguments=Derived(
                model=MoveJoints,
                properties={"positions": joints, "duration_s": {"maximum": gate.max_duration_s}, "dry_run": {}},
                required=["positions"],
            ),
            result=JointMove,
            handler=mover,
            open_world=True,
        )
    ]


class _JointMover:
    """The handler of move_joints."""

    def __init__(self, exposed: Exposed, limits: Mapping[str, JointLimit], gate: MotionGate) -> None:
        self._exposed = exposed
        self._limits = limits
        self._gate = gate

    async def __call__(self, arguments: MoveJoints, context: CallContext) -> JointMove:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        for name, value in arguments.positions.items():
            if name not in self._limits:
                raise unknown_name("positions", name, list(self._limits))
            limit = self._limits[name]
            if not limit.lower <= value <= limit.upper:
                raise InvalidInputError(
                    f"positions.{name} is {value:g}, expected from {limit.lower:g} to {limit.upper:g}.",
                    path=f"positions.{name}",
                )
        halt = threading.Event()
        return await context.run(
            lambda stage: self._move(arguments, context, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

    def _move(self, arguments: MoveJoints, context: CallContext, stage: Stage, halt: threading.Event) -> JointMove:
        exposed, gate = self._exposed, self._gate
        target, asked_s, dry_run = arguments.positions, arguments.duration_s, arguments.dry_run
        joints = gate.joints(exposed, _MEASURED_S)
        if joints is None:
            raise NotReadyError("The joints are not measured.", hint="Call start_robot first.")
        duration_s = asked_s or self._easy_s(target, joints)
        request = gate_request(
            context,
            "move_joints",
            exposed,
            [_message(target, duration_s)],
            arguments.given(),
            joints=joints,
            dry_run=dry_run,
        )
        if asked_s is None and (slower := gate.slowdown(request)) > 1.0:
            duration_s *= slower * 1.01  # rounding
            request = replace(request, messages=(_message(target, duration_s),))
        if dry_run:
            verdict = gate.ask(exposed, request)
            return self._answer(target, joints, duration_s, verdict.allowed, verdict.reason, True)
        commands = self._commands(target, request.messages[0], duration_s, stage)
        sent = gate.play(exposed, request, commands, total_s=duration_s, timeout_s=_MEASURED_S, halt=halt)
        if not sent.verdict.may_send:
            return self._answer(target, joints, 0.0, sent.verdict.allowed, sent.verdict.reason, True)
        return self._answer(target, gate.newest_joints(exposed) or joints, sent.duration_s, True, "", False)

    def _easy_s(self, target: Mapping[str, float], joints: JointSample) -> float:
        """Duration at which every joint uses at most a share of its velocity limit."""
        needed = [0.5]
        for name, value in target.items():
            limit, start = self._limits[name], _position(joints, name)
            distance, fastest = abs(value - start), limit.fastest(value, value > start)
            needed.append(distance / min(_EASY * limit.velocity, _NEARLY * fastest or limit.velocity))
            needed.append(shortest_s(distance, _EASY_ACCELERATION * limit.acceleration))
        return max(needed)

    def _is_there(self, target: Mapping[str, float], joints: JointSample) -> bool:
        profile = self._exposed.profile
        assert profile is not None
        return all(abs(value - _position(joints, name)) < profile.tolerance(name) for name, value in target.items())

    def _commands(
        self, target: Mapping[str, float], message: Any, duration_s: float, stage: Stage
    ) -> Iterator[Command]:
        """The trajectory, then waiting until the arm is measured at its end.

        Raises:
            StateError: the joints are not measured any more, or do not get there.
        """
        began_s = told_s = time.monotonic()
        yield Command(message=message, due_s=began_s)
        while True:
            now_s = time.monotonic()
            joints = self._gate.newest_joints(self._exposed)
            if joints is None:
                raise StateError("The joints are not measured any more.", hint="See get_status.")
            if now_s - began_s >= duration_s * 0.9 and self._is_there(target, joints):
                return
            if now_s - began_s > duration_s + _SETTLE_S:
                off = ", ".join(f"{n} {abs(v - _position(joints, n)):.4f}" for n, v in target.items())
                raise StateError(f"The joints do not come nearer to the target; they are off by {off} [rad or m].")
            if now_s - told_s >= 0.5:
                told_s = now_s
                stage(f"{now_s - began_s:.1f} of {duration_s:.1f} s, {_error(target, joints):.3f} to go")
            yield Command(message=None, due_s=now_s + 0.02)

    def _answer(
        self, target: Mapping[str, float], joints: JointSample, duration_s: float, allowed: bool, reason: str,
        dry_run: bool,
    ) -> JointMove:  # fmt: skip
        return JointMove(
            robot=self._exposed.robot,
            position={name: round(_position(joints, name), 5) for name in target},
            error=round(_error(target, joints), 5),
            duration_s=round(duration_s, 3),
            dry_run=dry_run,
            allowed=allowed,
            reason=reason,
        )


def _message(target: Mapping[str, float], duration_s: float) -> Any:
    """A JointTrajectory of one point."""
    from builtin_interfaces.msg import Duration  # heavy
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # heavy

    seconds, nanoseconds = divmod(round(duration_s * 1e9), 1_000_000_000)
    point = JointTrajectoryPoint(
        positions=[float(value) for value in target.values()],
        time_from_start=Duration(sec=seconds, nanosec=nanoseconds),
    )
    return JointTrajectory(joint_names=list(target), points=[point])


def _position(joints: JointSample, name: str) -> float:
    if name not in joints.names:
        raise NotReadyError(f"Joint {name!r} is not measured.", hint="See get_status.")
    return float(joints.position[joints.names.index(name)])


def _error(target: Mapping[str, float], joints: JointSample) -> float:
    return max(abs(value - _position(joints, name)) for name, value in target.items())
