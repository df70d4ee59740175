"""Tool move_ee: incremental moves of an arm's end effector, through the control module that also
executes policies.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from roboneuron.contract import Pose, RobotProfile
from roboneuron.contract.arrays import F64
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError, StateError
from roboneuron.server.clock import MotionTiming
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, TimedCommand
from roboneuron.server.rehearsal import DrivenArm, Needs, Rehearsal
from roboneuron.server.tool import CallContext
from roboneuron.supervisor.changes import Stage
from roboneuron.tools.arm.arm_rows import ArmRows, Rest, to_message
from roboneuron.tools.arm.ee_line import (
    STEP_S,
    Order,
    rounded,
    steps_to_end,
)
from roboneuron.tools.arm.ee_move import EndEffectorMove, MoveEndEffector, ee_answer
from roboneuron.tools.arm.grip import Grip, is_lost
from roboneuron.tools.arm.measured import MeasuredPose
from roboneuron.tools.arm.motion_meter import joint_margin
from roboneuron.tools.arm.options import ArmToolsOptions, fastest
from roboneuron.tools.arm.prediction import ArmControl, PredictedArm

_MEASURED_S, _POSE_S, _AFTER_S = 2.0, 0.5, 1.0
"""Longest wait for control and the first measurement, for later measurements, and for that after
the move.
"""
_FREE_JOINTS = 6
"""Least number of joints with which a hand can keep its rotation wherever it goes."""


@dataclass(kw_only=True, slots=True)
class _Line:
    """A move in progress; `start`, and `held` (the hand holds an object), are measured at its
    beginning, with which its `pace` begins.
    """

    order: Order
    start: Pose | None = None
    pace: MotionTiming | None = None
    held: bool | None = None
    kept: float | None = None


class EndEffectorMover:
    """The handler of move_ee for one arm; follows `Rehearsable`."""

    rehearsal_needs: Needs = frozenset({"control"})

    def __init__(
        self,
        exposed: ExposedEndpoint,
        profile: RobotProfile,
        host: Host,
        options: ArmToolsOptions,
        tcps: Mapping[str, MeasuredPose],
        arm: str = "",
    ) -> None:
        """Args:
        exposed: the action topic of the robot.
        profile: profile of the robot.
        host: host of the feature.
        options: options of the feature.
        tcps: the measured pose of each arm, by its name.
        arm: the moving arm.
        """
        self._exposed = exposed
        self._profile = profile
        self._gate = host.gate
        self._host = host
        self._options = options
        self._arm = arm
        self._tcp, self._tcps = tcps[arm], tcps
        self._clock = host.clock(exposed.namespace)
        self._grips = {name: Grip(host, self._gate, exposed, name) for name in tcps}
        self._grip = self._grips[arm]
        self._number = [part.name for part in profile.each_arm].index(arm)
        self._turns_freely = len(profile.each_arm[self._number].joints) >= _FREE_JOINTS

    async def __call__(self, arguments: MoveEndEffector, context: CallContext) -> EndEffectorMove:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError."""
        order = self.order(arguments)
        # stands for the actions to come, which are judged one by one; it is never sent
        any_rows = ArmRows.of(self._profile, self._arm, dict.fromkeys(self._tcps, Rest()))
        row = any_rows.row(Rest().pose, np.zeros(6), order.gripper_open or 0.0)
        request = GateRequest.of(
            context,
            "move_ee",
            self._exposed,
            [to_message(any_rows.space, row)],
            arguments.given(),
        )
        halt = threading.Event()
        return await context.run(
            lambda stage: self._move(order, request, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

    def check(self) -> None:
        """Check that the arm could be moved now. Raises RefusedError, StateError."""
        self._gate.check_free(self._exposed)
        self._host.modules.require_running("control")

    def pose(self) -> Pose:
        """The measured TCP; blocks. Raises as `MeasuredPose.wait`."""
        return self._tcp.wait(_MEASURED_S)

    @property
    def robot(self) -> str:
        """Name of the robot."""
        return self._exposed.robot

    @property
    def stops(self) -> int:
        """Number of stops of the arm so far."""
        return self._host.loop.starts.arm_stops

    @property
    def fastest(self) -> tuple[float, float]:
        """Fastest translation [m/s] and rotation [rad/s] in force."""
        return fastest(self._options, self._host.loop.limits)

    def predicted(self) -> PredictedArm:
        """The arm from where it is measured, to be driven by the caller, who closes it.

        Raises:
            RefusedError: the joints are not measured.
        """
        joints = self._gate.joints(self._exposed, _MEASURED_S)
        if joints is None:
            raise RefusedError(
                "The joints are not measured, so that the path cannot be judged.", rule="kinematics"
            )
        return PredictedArm(ArmControl.of(self._host, self._exposed), joints)

    def pose_of(self, arm: DrivenArm) -> Pose:
        """TCP of this arm among those of a driven robot."""
        return arm.poses()[self._number]

    def order(self, arguments: MoveEndEffector) -> Order:
        """The move that a call asks for. Raises InvalidInputError, RefusedError."""
        values = arguments.delta()
        gripper = arguments.gripper_open
        if gripper is not None:
            self._grip.check_fitted()
        if gripper is None and not values.any():
            raise InvalidInputError(
                "The call asks for no move.", hint="Give one of the deltas, or gripper_open."
            )
        speed_m_s, turn_rad_s = self.fastest
        distance_m, turn_rad = float(np.linalg.norm(values[:3])), float(np.linalg.norm(values[3:]))
        shortest_s = max(distance_m / speed_m_s, turn_rad / turn_rad_s, STEP_S)
        asked_s = arguments.duration_s
        if asked_s is not None and asked_s < shortest_s * 0.999:
            raise RefusedError(
                f"A move of {distance_m:.3f} m and {turn_rad:.2f} rad in {asked_s:g} s is too "
                "fast: at least "
                f"{shortest_s:.2f} s are needed.",
                hint="Give it more time, or leave duration_s away.",
                rule="speed",
            )
        return Order(
            translation_m=values[:3],
            rotation_rad=values[3:],
            gripper_open=gripper,
            duration_s=asked_s or shortest_s,
            keeps_rotation=bool(values[3:].any()) or self._turns_freely,
        )

    def _rows(self, poses: Mapping[str, Pose]) -> ArmRows:
        """Create the rows of a motion that begins now.

        Args:
            poses: TCP of each arm, by its name.

        Raises:
            NotReadyError: a gripper is not measured.
        """
        return ArmRows.of(
            self._profile,
            self._arm,
            {
                name: Rest(pose=pose, opening=self._grips[name].kept())
                for name, pose in poses.items()
            },
        )

    def _move(
        self, order: Order, request: GateRequest, stage: Stage, halt: threading.Event
    ) -> EndEffectorMove:
        gate, exposed = self._gate, self._exposed
        if request.simulated:
            return self._judge(order, request)
        self.check()
        for tcp in self._tcps.values():  # a motion that waits for long counts as frozen
            tcp.wait(_MEASURED_S)
        line, began_s = _Line(order=order), time.monotonic()
        sent = gate.play(
            exposed,
            request,
            self._actions(line, stage),
            total_s=order.duration_s,
            timeout_s=_MEASURED_S,
            halt=halt,
            details=lambda: self._where(line),
        )
        if not sent.verdict.may_send:
            verdict = sent.verdict
            return ee_answer(
                self.robot,
                self._arm,
                order,
                0,
                0.0,
                None,
                None,
                allowed=verdict.allowed,
                reason=verdict.reason,
                simulated=True,
            )
        end = self._end(line)
        answer = ee_answer(
            self.robot, self._arm, order, sent.messages, sent.duration_s, line.start, end
        )
        speed = self._tcp.speeds.fastest_since(began_s)
        measured = {
            "max_tcp_speed_m_s": None if speed is None else round(speed, 3),
            "joint_margin": joint_margin(self._profile, gate.joints(exposed, _POSE_S)),
        }
        return answer.model_copy(update={**self._grip_at_the_end(line), **measured})

    def _end(self, line: _Line) -> Pose:
        """The TCP after a move. Raises NotReadyError."""
        if line.pace is None:
            return self._tcp.wait(_AFTER_S)
        line.pace.settle()
        return self._tcp.wait(_AFTER_S, line.pace.newer_than_ns())

    def _judge(self, order: Order, request: GateRequest) -> EndEffectorMove:
        """Answer a simulated call: predicted TCP, duration, and reasons for a refusal."""
        reason = self._why_not()
        took_s = order.duration_s

        def predict() -> None:
            """Raise RefusedError unless control would complete the move."""
            nonlocal took_s
            took_s = 0.0
            with closing(self.predicted()) as arm:
                for _ in self.drive(order, arm):
                    took_s += STEP_S

        request = replace(request, predict=None if reason else predict)
        verdict = self._gate.check(request)
        is_latched = verdict.rule == "emergency_stop"
        answer = ee_answer(
            self.robot,
            self._arm,
            order,
            0,
            took_s,
            self._known_pose(),
            None,
            allowed=verdict.allowed and not reason,
            reason=verdict.reason if is_latched else reason or verdict.reason,
            simulated=True,
        )
        return answer.model_copy(update={"holding": self._grip.holding()})

    def _known_pose(self) -> Pose | None:
        """Measured TCP; None if control reports none."""
        try:
            return self._tcp.wait(_POSE_S)
        except RoboNeuronError:
            return None

    def _grip_at_the_end(self, line: _Line) -> dict[str, bool | None]:
        holding = self._grip.holding()
        lost = is_lost(line.held, holding, line.order.gripper_open, line.kept)
        return {"holding": holding, "lost_on_the_way": lost}

    def _actions(self, line: _Line, stage: Stage) -> Iterator[TimedCommand]:
        """Follow the line from measured poses; ends when the arm has arrived.

        Raises:
            RefusedError: control held the arm, with its reason.
            NotReadyError: control or the gripper is not measured.
            StateError: the arm did not arrive.
        """
        order = line.order
        pace = line.pace = self._clock.motion(STEP_S)
        poses = {
            name: tcp.wait(_MEASURED_S, pace.newer_than_ns()) for name, tcp in self._tcps.items()
        }
        start = line.start = poses[self._arm]
        rows = self._rows(poses)
        line.kept, line.held = self._grip.kept(), self._grip.holding()
        gripper = line.kept if order.gripper_open is None else order.gripper_open

        def pose() -> Pose:
            return self._tcp.wait(_POSE_S, pace.newer_than_ns())

        steps = self._steps(order, start, pose, pace.elapsed_s, self._note)
        for sent, (fraction, distance_m, here, delta) in enumerate(steps):
            if sent % 5 == 0:
                stage(f"{100 * fraction:.0f} % of the way, {distance_m * 1000:.0f} mm to go")
            message = to_message(rows.space, rows.row(here, delta, gripper))
            yield from pace.play(message)

    def drive(self, order: Order, arm: DrivenArm) -> Iterator[None]:
        """Have another arm than the robot's make the move, action by action, as control would; ends
        when it is there.

        Raises:
            RefusedError: it does not get there, and why.
            NotReadyError: the gripper is not measured.
        """
        gripper = self._grip.kept() if order.gripper_open is None else order.gripper_open
        rows = self._rows(dict(zip(self._tcps, arm.poses(), strict=True)))
        ticks = count()

        def pose() -> Pose:
            return arm.poses()[self._number]

        def note() -> str:
            return f"holding: {arm.held}" if arm.held else "limits shorten its steps"

        try:
            for _, _, here, delta in self._steps(
                order, pose(), pose, lambda: next(ticks) * STEP_S, note
            ):
                arm.follow(rows.space, rows.row(here, delta, gripper), STEP_S)
                yield
        except StateError as error:
            raise RefusedError(error.message, rule="path") from error

    def rehearse(self, arguments: MoveEndEffector, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`."""
        for _ in self.drive(self.order(arguments), rehearsal.arm):
            pass
        rehearsal.arm.settle()

    def _steps(
        self,
        order: Order,
        start: Pose,
        pose: Callable[[], Pose],
        elapsed_s: Callable[[], float],
        note: Callable[[], str],
    ) -> Iterator[tuple[float, float, Pose, F64]]:
        """Call `steps_to_end` with the speeds in force."""
        longest_s = self._gate.max_duration_s
        return steps_to_end(
            order, start, pose, elapsed_s, note, speeds=self.fastest, longest_s=longest_s
        )

    def _note(self) -> str:
        """Control's status note."""
        report = self._host.modules.view("control").report
        return report.note if report is not None else ""

    def _where(self, line: _Line) -> str:
        try:
            place = f"the TCP is at {rounded(self._tcp.wait(1.0).position_m)} m"
        except RoboNeuronError as error:
            return error.message
        if not line.held:
            return place
        lost = self._grip_at_the_end(line)["lost_on_the_way"]
        return f"{place}; the hand {'has lost what it held' if lost else 'still holds something'}"

    def _why_not(self) -> str:
        try:
            self.check()
        except RoboNeuronError as error:
            return str(error)
        return ""
