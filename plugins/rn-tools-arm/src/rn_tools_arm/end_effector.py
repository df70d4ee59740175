"""move_ee: incremental moves of an arm's end effector, through the control module that also follows policies."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from rn_tools_arm.ee_line import F64, STEP_S, Order, difference, limit_step, remaining, rounded
from rn_tools_arm.options import ArmToolsOptions
from rn_tools_ros.arguments import Number, check_names, take_flag
from roboneuron.contract import ACTION_LABEL, ACTION_SIZE, Pose, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest
from roboneuron.server.host import Host
from roboneuron.server.motion.delivery import Command
from roboneuron.server.motion.exposed import Exposed, gate_request
from roboneuron.server.tool import Answer, CallContext, Result, Stage

_FURTHEST_M, _FURTHEST_RAD = 0.5, 1.6
_REACHED_M, _REACHED_RAD = 0.002, 0.01
_SETTLE_S = 2.0
"""How long the arm gets, after the nominal duration, to come as near as that."""
_GRIPPER_S = 0.8
_MEASURED_S, _POSE_S = 2.0, 0.5
"""Longest wait for control and the first measurement, and for the next ones."""
_AXES = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad")


class EndEffectorMove(Result):
    """What the arm did, measured."""

    robot: str
    asked: dict[str, float] = Field(description="the move that was asked for")
    moved: dict[str, float] = Field(description="the move that was measured, in the base frame")
    position_m: list[float] = Field(description="measured TCP position at the end, base frame")
    error_m: float = Field(description="distance from where it should be")
    error_rad: float
    sent: int = Field(description="actions")
    duration_s: float
    dry_run: bool
    allowed: bool
    reason: str


@dataclass(kw_only=True, slots=True)
class _Line:
    """A move that is under way; `start` is measured when it begins."""

    order: Order
    start: Pose | None = None


class EndEffectorMover:
    """The handler of move_ee."""

    def __init__(self, exposed: Exposed, profile: RobotProfile, host: Host, options: ArmToolsOptions) -> None:
        self._exposed = exposed
        self._profile = profile
        self._gate = host.gate
        self._host = host
        self._options = options
        axis = {"x": "forwards", "y": "to the left", "z": "up"}
        self.numbers = {
            **{f"d{a}_m": Number(text=f"Along {a} of the base ({word}) [m].", low=-_FURTHEST_M, high=_FURTHEST_M,
                                 default=0.0) for a, word in axis.items()},
            **{f"r{a}_rad": Number(text=f"Rotation vector, {a} component [rad].", low=-_FURTHEST_RAD,
                                   high=_FURTHEST_RAD, default=0.0) for a in axis},
            "gripper_open": Number(text="Opening, 0 closed .. 1 open; kept when omitted.", low=0.0, high=1.0),
            "duration_s": Number(text="Time for the move; as fast as allowed when omitted [s].", low=0.0,
                                 high=host.gate.max_duration_s, above=True),
        }  # fmt: skip

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        known = [*self.numbers, "dry_run"]
        if self._profile.gripper is None:
            known.remove("gripper_open")
        check_names(arguments, known)
        order = self._order(arguments)
        dry_run = take_flag(arguments, "dry_run")
        request = gate_request(
            context, "move_ee", self._exposed, [self._message(np.zeros(6), order.gripper_open or 0.0)], arguments,
            dry_run=dry_run,
        )  # fmt: skip
        halt = threading.Event()
        return await context.run(
            lambda stage: self._move(order, request, stage, halt), on_cancel=halt.set, on_leave=halt.set
        )

    def _order(self, arguments: Mapping[str, Any]) -> Order:
        values = np.array([self.numbers[name].take(name, arguments) for name in _AXES])
        gripper = None
        if arguments.get("gripper_open") is not None:
            gripper = self.numbers["gripper_open"].take("gripper_open", arguments)
        if gripper is None and not values.any():
            raise InvalidInputError("The call asks for no move.", hint="Give one of the deltas, or gripper_open.")
        options = self._options
        distance_m, turn_rad = float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))
        shortest_s = max(distance_m / options.ee_speed_m_s, turn_rad / options.ee_turn_rad_s, STEP_S)
        asked_s = None
        if arguments.get("duration_s") is not None:
            asked_s = self.numbers["duration_s"].take("duration_s", arguments)
        if asked_s is not None and asked_s < shortest_s * 0.999:
            raise RefusedError(
                f"A move of {distance_m:.3f} m and {turn_rad:.2f} rad in {asked_s:g} s is too fast: at least "
                f"{shortest_s:.2f} s are needed.",
                hint="Give it more time, or leave duration_s away.",
            )
        return Order(
            translation_m=values[:3], rotation_rad=values[3:], gripper_open=gripper, duration_s=asked_s or shortest_s
        )

    def _message(self, delta: F64, gripper_open: float) -> Any:
        """An action of the contract: deltas of the TCP in the base frame, and the gripper."""
        from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout  # heavy

        values = np.append(delta, min(1.0, max(0.0, gripper_open))).tolist()
        dimension = MultiArrayDimension(label=ACTION_LABEL, size=ACTION_SIZE, stride=ACTION_SIZE)
        return Float64MultiArray(layout=MultiArrayLayout(dim=[dimension]), data=values)

    def _move(self, order: Order, request: GateRequest, stage: Stage, halt: threading.Event) -> Answer:
        gate, exposed = self._gate, self._exposed
        if request.dry_run:
            reason = self._why_not()
            verdict = gate.check(request)
            return self._answer(order, 0, 0.0, None, None, allowed=verdict.allowed and not reason,
                                reason=reason or verdict.reason, dry_run=True)  # fmt: skip
        gate.check_free(exposed)
        self._host.supervisor.require_running("control")
        line = _Line(order=order)
        sent = gate.play(
            exposed, request, self._actions(line, stage), total_s=order.duration_s, timeout_s=_MEASURED_S, halt=halt,
            details=self._where,
        )  # fmt: skip
        if not sent.verdict.may_send:
            return self._answer(order, 0, 0.0, None, None, allowed=True, reason="", dry_run=True)
        return self._answer(order, sent.messages, sent.duration_s, line.start, gate.ee_pose(exposed, 1.0))

    def _actions(self, line: _Line, stage: Stage) -> Iterator[Command]:
        """Follow the line by the measured pose; ends when the arm is there.

        Raises:
            RefusedError: control held the arm, with its reason.
            NotReadyError: control or the gripper is not measured.
            StateError: the arm did not get there.
        """
        gate, exposed, options, order = self._gate, self._exposed, self._options, line.order
        start = line.start = gate.ee_pose(exposed, _MEASURED_S)
        gripper = order.gripper_open if order.gripper_open is not None else self._opening()
        began_s, sent = time.monotonic(), 0
        least_s = max(order.duration_s, _GRIPPER_S if order.gripper_open is not None else 0.0)
        while True:
            elapsed_s = time.monotonic() - began_s
            measured = gate.ee_pose(exposed, _POSE_S)
            goal_error = remaining(start, order, 1.0, measured)
            reached = np.linalg.norm(goal_error[:3]) < _REACHED_M and np.linalg.norm(goal_error[3:]) < _REACHED_RAD
            if reached and elapsed_s >= least_s:
                return
            if elapsed_s > least_s + _SETTLE_S:
                raise self._short(goal_error)
            fraction = min(1.0, (elapsed_s + STEP_S) / order.duration_s)
            delta = limit_step(remaining(start, order, fraction, measured), options.ee_speed_m_s, options.ee_turn_rad_s)
            sent += 1
            if sent % 5 == 1:
                stage(f"{100 * fraction:.0f} % of the way, {np.linalg.norm(goal_error[:3]) * 1000:.0f} mm to go")
            yield Command(message=self._message(delta, gripper), due_s=time.monotonic() + STEP_S)

    def _short(self, error: F64) -> RoboNeuronError:
        report = self._host.supervisor.view("control").report
        note = report.note if report is not None else ""
        off_m, off_rad = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        text = f"The end effector is {off_m * 1000:.1f} mm and {off_rad:.3f} rad short"
        if note.startswith("holding"):
            return RefusedError(f"{text}; control is {note}")
        return StateError(f"{text} ({note or 'no report of control'}).")

    def _where(self) -> str:
        try:
            return f"the TCP is at {rounded(self._gate.ee_pose(self._exposed, 1.0).position_m)} m"
        except RoboNeuronError as error:
            return error.message

    def _why_not(self) -> str:
        try:
            self._gate.check_free(self._exposed)
            self._host.supervisor.require_running("control")
        except RoboNeuronError as error:
            return str(error)
        return ""

    def _opening(self) -> float:
        """The measured opening of the gripper, so that it is kept; 1 without one."""
        gripper = self._profile.gripper
        if gripper is None:
            return 1.0
        joints = self._gate.joints(self._exposed, 2.0)
        if joints is None or gripper.joint not in joints.names:
            raise NotReadyError("The gripper was not measured.", hint="Is the robot running? See get_status.")
        return gripper.to_opening(float(joints.position[joints.names.index(gripper.joint)]))

    def _answer(
        self, order: Order, sent: int, duration_s: float, start: Pose | None, end: Pose | None, *,
        allowed: bool = True, reason: str = "", dry_run: bool = False,
    ) -> Answer:  # fmt: skip
        moved, error = np.zeros(6), np.zeros(6)
        if start is not None and end is not None:
            moved = difference(start, end)
            error = remaining(start, order, 1.0, end)
        asked = dict(zip(_AXES, [*order.translation_m.tolist(), *order.rotation_rad.tolist()], strict=True))
        if order.gripper_open is not None:
            asked["gripper_open"] = order.gripper_open
        return Answer(
            structured={
                "robot": self._exposed.robot,
                "asked": asked,
                "moved": dict(zip(_AXES, rounded(moved), strict=True)),
                "position_m": rounded(end.position_m) if end is not None else [],
                "error_m": round(float(np.linalg.norm(error[:3])), 5),
                "error_rad": round(float(np.linalg.norm(error[3:])), 5),
                "sent": sent,
                "duration_s": round(duration_s, 3),
                "dry_run": dry_run,
                "allowed": allowed,
                "reason": reason,
            }
        )
