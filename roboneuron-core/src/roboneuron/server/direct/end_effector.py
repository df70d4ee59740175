"""move_ee: incremental moves of an arm's end effector, through the control module that also follows policies."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from roboneuron.contract import Pose, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest
from roboneuron.ros.topics import EE_POSE
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number, check_names, take_flag
from roboneuron.server.direct.ee_line import F64, STEP_S, Order, difference, limit_step, remaining, rounded
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.motion import Motion
from roboneuron.server.direct.request import gate_request
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import Answer, CallContext, Result, Stage

_FURTHEST_M, _FURTHEST_RAD = 0.5, 1.6
_REACHED_M, _REACHED_RAD = 0.002, 0.01
_SETTLE_S = 2.0
"""How long the arm gets, after the nominal duration, to come as near as that."""
_GRIPPER_S = 0.8
_POSE_AGE_S = 0.5
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


class EndEffectorMover:
    """The handler of move_ee."""

    def __init__(self, exposed: Exposed, profile: RobotProfile, access: Access, loop: ClosedLoop) -> None:
        self._exposed = exposed
        self._profile = profile
        self._access = access
        self._loop = loop
        self._pose: Any = None
        self._lock = threading.Lock()
        axis = {"x": "forwards", "y": "to the left", "z": "up"}
        self.numbers = {
            **{f"d{a}_m": Number(text=f"Along {a} of the base ({word}) [m].", low=-_FURTHEST_M, high=_FURTHEST_M,
                                 default=0.0) for a, word in axis.items()},
            **{f"r{a}_rad": Number(text=f"Rotation vector, {a} component [rad].", low=-_FURTHEST_RAD,
                                   high=_FURTHEST_RAD, default=0.0) for a in axis},
            "gripper_open": Number(text="Opening, 0 closed .. 1 open; kept when omitted.", low=0.0, high=1.0),
            "duration_s": Number(text="Time for the move; as fast as allowed when omitted [s].", low=0.0,
                                 high=access.max_duration_s, above=True),
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
        config = self._loop.base.direct
        distance_m, turn_rad = float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))
        shortest_s = max(distance_m / config.ee_speed_m_s, turn_rad / config.ee_turn_rad_s, STEP_S)
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
        from roboneuron.ros.messages import to_action_message  # heavy

        return to_action_message(np.append(delta, min(1.0, max(0.0, gripper_open))))

    def _move(self, order: Order, request: GateRequest, stage: Stage, halt: threading.Event) -> Answer:
        if request.dry_run:
            reason = self._why_not()
            verdict = self._access.gate.check(request)
            return self._answer(order, 0, 0.0, None, None, allowed=verdict.allowed and not reason,
                                reason=reason or verdict.reason, dry_run=True)  # fmt: skip
        with self._access.desk.claim(self._exposed, "move_ee", halt) as motion:
            self._loop.supervisor.require_running("control")
            verdict = self._access.gate.check(request)
            if not verdict.may_send:
                return self._answer(order, 0, 0.0, None, None, allowed=True, reason="", dry_run=True)
            start = self._measured(2.0)
            gripper = order.gripper_open if order.gripper_open is not None else self._opening()
            writer = self._access.traffic.writer(self._exposed)
            if not writer.connect(2.0):
                raise NotReadyError("Control does not listen for actions: nothing was sent.", hint="See get_status.")
            started_s = time.monotonic()
            sent = 0
            try:
                sent = self._play(order, start, gripper, writer, motion, stage)
            except (RefusedError, StateError) as error:
                end = self._measured(1.0)
                after_s = time.monotonic() - started_s
                cause = error.message.replace(" Nothing was sent.", "")
                raise type(error)(
                    f"Ended after {after_s:.2f} s at {rounded(end.position_m)} m, control holds the arm: {cause}",
                    hint=error.hint,
                ) from error
            end = self._measured(1.0)
            return self._answer(order, sent, time.monotonic() - started_s, start, end)

    def _play(self, order: Order, start: Pose, gripper: float, writer: Any, motion: Motion, stage: Stage) -> int:
        """Follow the line by the measured pose; ends when the arm is there. Returns the number of actions.

        Raises:
            RefusedError: control held the arm, with its reason.
            StateError: the arm did not get there; or as `Motion.check`.
        """
        config = self._loop.base.direct
        began_s, sent = time.monotonic(), 0
        least_s = max(order.duration_s, _GRIPPER_S if order.gripper_open is not None else 0.0)
        while True:
            elapsed_s = time.monotonic() - began_s
            measured = self._measured(_POSE_AGE_S)
            goal_error = remaining(start, order, 1.0, measured)
            reached = np.linalg.norm(goal_error[:3]) < _REACHED_M and np.linalg.norm(goal_error[3:]) < _REACHED_RAD
            if reached and elapsed_s >= least_s:
                return sent
            if elapsed_s > least_s + _SETTLE_S:
                raise self._short(goal_error)
            fraction = min(1.0, (elapsed_s + STEP_S) / order.duration_s)
            delta = limit_step(remaining(start, order, fraction, measured), config.ee_speed_m_s, config.ee_turn_rad_s)
            writer.publish(self._message(delta, gripper))
            sent += 1
            if sent % 5 == 1:
                stage(f"{100 * fraction:.0f} % of the way, {np.linalg.norm(goal_error[:3]) * 1000:.0f} mm to go")
            motion.sleep_until(time.monotonic() + STEP_S)

    def _short(self, error: F64) -> RoboNeuronError:
        report = self._loop.supervisor.view("control").report
        note = report.note if report is not None else ""
        off_m, off_rad = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        text = f"The end effector is {off_m * 1000:.1f} mm and {off_rad:.3f} rad short"
        if note.startswith("holding"):
            return RefusedError(f"{text}; control is {note}")
        return StateError(f"{text} ({note or 'no report of control'}).")

    def _why_not(self) -> str:
        try:
            self._access.desk.check_free(self._exposed)
            self._loop.supervisor.require_running("control")
        except RoboNeuronError as error:
            return str(error)
        return ""

    def _measured(self, timeout_s: float) -> Pose:
        from geometry_msgs.msg import PoseStamped  # heavy

        from roboneuron.ros.messages import pose_from_message  # heavy
        from roboneuron.ros.reader import NewestMessage  # heavy

        with self._lock:
            if self._pose is None:
                topic = f"/{self._exposed.namespace}/{EE_POSE}"
                self._pose = NewestMessage(self._access.traffic.link(), PoseStamped, topic)
        self._pose.open(timeout_s)
        deadline_s = time.monotonic() + timeout_s
        while True:
            message = self._pose.newest(_POSE_AGE_S)
            if message is not None:
                return pose_from_message(message)
            if time.monotonic() > deadline_s:
                raise NotReadyError("Control publishes no pose of the end effector.", hint="See get_status.")
            time.sleep(0.01)

    def _opening(self) -> float:
        """The measured opening of the gripper, so that it is kept; 1 without one."""
        gripper = self._profile.gripper
        if gripper is None:
            return 1.0
        joints = self._access.traffic.joints(self._exposed, 2.0)
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
