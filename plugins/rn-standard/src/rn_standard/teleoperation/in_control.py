"""Execution of a lead in the control process: its rows become joint commands like actions, while
the policy waits or is corrected by them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np
from std_msgs.msg import Float64MultiArray

from rn_standard.teleoperation.authority import Authority
from rn_standard.teleoperation.braking import Braking, is_away, stoppable
from rn_standard.teleoperation.correction import Correction
from rn_standard.teleoperation.executed import Executed
from rn_standard.teleoperation.rows import Acting, LeadRow
from rn_standard.teleoperation.samples import F64
from roboneuron import (
    GRIPPER,
    Action,
    ControlSpace,
    Hold,
    InvalidInputError,
    JointCommand,
    JointSample,
    RoboNeuronError,
    SpaceController,
    matrix_from_quaternion,
)
from roboneuron.direct_path.exposed import ACTING_TOPIC, LEAD_TOPIC
from roboneuron.feature import Asked, LimitedCommand, Module, ModuleHost
from roboneuron.modules.control.module import ControlModule
from roboneuron.modules.step_filters import ActionStep, StepFilter

_LOOK_S = 0.02
_STALE_S = 0.15
"""Maximum age of a row: a delayed one no longer represents the person's command."""
_AHEAD_S = 0.1
_SHARE_OF_REST = 0.5
"""As for the rows of a policy: fraction of a row's remaining time that is added to the next one."""
_STILL = LeadRow(session="", number=0, mode="person", kind="still", values=np.zeros(0))
"""Row that brakes the arm; lasts for one `_LOOK_S`."""
_LOST = "the lead was lost: lead the arm again, or give an instruction"


def join(host: ModuleHost) -> None:
    """See `FeatureSpec.on_join`."""
    if host.settings.kind == "control":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    if isinstance(module, ControlModule):
        module.filters.add(LeadInControl(module))


class LeadInControl(StepFilter):
    """Executes the rows of a lead, and lets the policy act without a lead.

    Used on the executor's thread.
    """

    phase = StepFilter.StepPhase.PERSON

    def __init__(self, control: ControlModule) -> None:
        self._control = control
        self._node = control.node
        self._authority = Authority()
        self._correction = Correction()
        self._executed = Executed(poses=control.poses)
        self._braking = Braking(step=self._brake, is_holding=self._is_holding)
        self._is_ending = False
        self._limited: LimitedCommand | None = None
        self._acting = self._node.advertise(Float64MultiArray, ACTING_TOPIC)
        self._node.subscribe(Float64MultiArray, LEAD_TOPIC, self._on_lead)
        self._node.repeat(_LOOK_S, self._look)

    def _forget(self) -> None:
        """Forget the command before, ahead of another row or action."""
        self._limited = None
        self._executed.begin()

    def note_limited(self, limited: LimitedCommand) -> None:
        """See `StepFilter.note_limited`."""
        self._limited = limited
        command = limited.command
        self._executed.command = command if isinstance(command, JointCommand) else None

    def act(self, step: ActionStep, proceed: Callable[[ActionStep], None]) -> None:
        """Execute an action of the policy, with the person's correction if there is one, unless a
        person leads.
        """
        reason = self._authority.why_no_policy(step.source_ns)
        if reason:
            if self._control.is_active:
                self._control.status.drop(reason)
            return
        row = self._authority.row
        self._forget()
        if row is not None:
            proceed(replace(step, read=lambda: self._corrected(step.read(), row)))
        else:
            proceed(step)
        who = "policy" if row is None or row.kind in ("rest", "still") else "blend"
        self._tell(who, step.source_ns)

    def _on_lead(self, message: Float64MultiArray, info: dict[str, Any]) -> None:
        source_ns = int(info["source_timestamp"])
        control, now_s = self._control, time.monotonic()
        try:
            row = LeadRow.from_message(message)
        except RoboNeuronError as error:
            control.status.drop("bad_lead")
            control.status.set_error(error)
            return
        age_s = (time.time_ns() - source_ns) / 1e9
        if not -_AHEAD_S <= age_s <= _STALE_S:
            control.status.drop("stale_lead")
            return
        if self._is_ending:
            control.status.drop("lead_ended")
            return
        self._forget()
        if row.mode in ("back", "lost"):
            self._end(row, source_ns)
            return
        reason = self._authority.take(row, now_s)
        if reason:
            control.status.drop(reason)
            # its arm is braked since the silence was detected
            self._tell("nobody", source_ns, "" if reason != "lead_needs_release" else _AGAIN)
            return
        if row.mode == "person":
            self._follow(row, source_ns)
        elif row.kind in ("rest", "still"):
            self._correction.reset()
            self._tell("policy", source_ns)

    def _follow(self, row: LeadRow, source_ns: int) -> None:
        """Execute a row of the person."""
        if row.kind == "rest":
            self._hold("lead_rests", "The person who leads asks for nothing.")
            self._tell("person", source_ns)
            return
        self._control.act(source_ns, lambda: Asked(now=partial(self._answer, row)))
        self._tell("person", source_ns)

    def _end(self, row: LeadRow, source_ns: int) -> None:
        led = self._authority.row
        if led is not None and led.session != row.session:
            self._control.status.drop("other_lead")
            return
        self._authority.row = row
        if row.mode == "lost":
            self._is_ending = True
            self._braking.reset()
            self._look()
            self._tell("nobody", source_ns)
            return
        self._release(source_ns)
        self._tell("policy", source_ns)

    def _release(self, now_ns: int) -> None:
        """Return the authority to the policy, from its next action on. The present command comes to
        its end: a hold would cause a jerk.
        """
        self._correction.reset()
        self._authority.release(now_ns)

    def _look(self) -> None:
        """Check for a silent lead, and brake the arm of one that is silent or lost."""
        if self._control.is_holding:
            self._control.status.set_value("acting", "nobody")
        now_s = time.monotonic()
        found = "lost" if self._is_ending else self._authority.look(now_s)
        # after a silence, braking goes on although rows come again
        if not found and self._authority.who != "nobody":
            self._braking.reset()
            return
        if not self._braking.advance(now_s):
            return
        if found == "lost":
            self._is_ending = False
            self._hold("lead_lost", _LOST)
            self._release(time.time_ns())
            self._require_start()
            self._tell("nobody", time.time_ns())
        elif found != "late":
            self._hold("lead_silent", "The lead is silent.")

    def _brake(self) -> bool:
        """See `Braking`."""
        self._forget()
        self._control.act(time.time_ns(), lambda: Asked(now=partial(self._answer, _STILL)))
        command, measured = self._executed.command, self._control.watched.joints
        if self._limited is None or command is None or measured is None:
            return False
        return bool(self._limited.acted) or is_away(command, measured, self._control.profile.kinds)

    def _is_holding(self) -> bool:
        return self._control.is_holding or not self._control.is_active

    def _require_start(self) -> None:
        """Require a new start of motion; in shadow this is left to the control that moves
        the arm.
        """
        if self._control.is_active and self._control.filters.is_ours(time.time_ns()):
            self._node.require_start(_LOST)

    def _hold(self, code: str, reason: str) -> None:
        if self._control.is_active:
            self._control.hold(code, reason)

    def _answer(
        self, row: LeadRow, joints: JointSample, step_s: float, now_s: float
    ) -> JointCommand | Hold:
        """Compute the command for one row, from the end of the command in progress."""
        period_s = 1.0 / row.rate_hz
        self._executed.start = reference = self._control.reference(joints, now_s)
        answer = self._moved(row, reference, period_s)
        if isinstance(answer, Hold):
            return answer
        # the rest of the previous row is not rushed
        more_s = _SHARE_OF_REST * self._control.remaining_s(now_s)
        return replace(answer, duration_s=answer.duration_s + more_s)

    def _moved(self, row: LeadRow, joints: JointSample, period_s: float) -> JointCommand | Hold:
        """Compute the result of a row from these joints in one period [s]."""
        profile = self._control.profile
        if row.kind == "still":
            found = dict(zip(joints.names, joints.position.tolist(), strict=False))
            absent = [joint for joint in profile.arm_joints if joint not in found]
            if absent:
                return Hold(code="lead_unmeasured", reason=f"{absent} are not measured.")
            position = np.array([found[joint] for joint in profile.arm_joints])
            return JointCommand(names=profile.arm_joints, position=position, duration_s=period_s)
        if row.kind == "twist":
            answer = self._shifted(
                twist_in_base(row, self._rotation(joints)) * period_s, row, joints
            )
        else:
            answer = self._joints(row, joints, period_s)
        if isinstance(answer, Hold):
            return answer
        return stoppable(self._without_gripper(answer, row), joints, profile)

    def _rotation(self, joints: JointSample) -> F64:
        """Rotation of the TCP in the base, float64 (3, 3)."""
        return matrix_from_quaternion(self._control.poses(joints)[0].quaternion_xyzw)

    def _shifted(self, delta: F64, row: LeadRow, joints: JointSample) -> JointCommand | Hold:
        """Compute the command that moves the TCP by a delta (6,) in the base."""
        opening = 0.0 if row.gripper_open is None else row.gripper_open
        action = Action(translation_m=delta[:3], rotation_rad=delta[3:], gripper_open=opening)
        return self._control.controller.compute(action, joints, 1.0 / row.rate_hz)

    def _joints(self, row: LeadRow, joints: JointSample, period_s: float) -> JointCommand | Hold:
        """Compute the command for a row of joint velocities or positions."""
        try:
            space = self._space(row.kind)
            values = space_row(space, row, joints)
        except InvalidInputError as error:
            return Hold(code="bad_lead", reason=error.message)
        controller = cast("SpaceController", self._control.controller)
        return controller.execute(space, values, joints, period_s)

    def _space(self, kind: str) -> ControlSpace:
        for space in self._control.spaces.values():
            if space.kind == kind:
                return space
        raise InvalidInputError(f"The controller executes no {kind}; lead the TCP instead.")

    def _without_gripper(self, command: JointCommand, row: LeadRow) -> JointCommand:
        """Remove fingers without a command, so that they keep their grasp."""
        if row.gripper_open is not None:
            return command
        arm = self._control.profile.arm_joints
        keep = [index for index, name in enumerate(command.names) if name in arm]
        names = tuple(command.names[index] for index in keep)
        return replace(command, names=names, position=command.position[keep])

    def _corrected(self, asked: Asked, row: LeadRow) -> Asked:
        """Add the person's correction to the policy's action. Planned rows are removed, because
        they do not contain it.
        """
        self._correction.is_kept = self._control.space is not None and (
            self._control.space.is_absolute
        )
        if row.kind in ("rest", "still"):
            return asked

        def now(joints: JointSample, step_s: float, now_s: float) -> JointCommand | Hold:
            command = asked.now(joints, step_s, now_s)
            if isinstance(command, Hold):
                return command
            self._executed.start = joints
            return self._on_top(command, row, joints, step_s)

        return Asked(now=now)

    def _on_top(
        self, command: JointCommand, row: LeadRow, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Move a command of the policy by the person's correction during its time."""
        found = dict(zip(joints.names, joints.position.tolist(), strict=False))
        found.update(zip(command.names, command.position.tolist(), strict=False))
        there = JointSample(
            names=tuple(found), position=np.array(list(found.values())), stamp_ns=joints.stamp_ns
        )
        if row.kind == "twist":
            delta = self._correction.add(twist_in_base(row, self._rotation(there)), step_s)
            answer = self._shifted(delta, row, there)
        else:
            answer = self._joints(row, there, step_s)
        if isinstance(answer, Hold):
            return answer
        moved = self._without_gripper(answer, row)
        position = dict(zip(command.names, command.position.tolist(), strict=True))
        position.update(zip(moved.names, moved.position.tolist(), strict=True))
        return replace(
            command,
            names=tuple(position),
            position=np.array(list(position.values())),
            duration_s=max(command.duration_s, step_s),
        )

    def _tell(self, who: str, source_ns: int, note: str = "") -> None:
        """Report the source that moved the arm, and the limits that acted."""
        control, row = self._control, self._authority.row
        if not control.is_active or not control.filters.is_ours(source_ns):
            return
        limited = self._limited
        if not note and (reason := control.why_stopped()):
            who, note = "nobody", f"{reason}: {self._node.needs_start}".rstrip(": ")
        if not note and limited is not None:
            note = limited.reason if limited.acted else ""
        is_led = row is not None and who in ("person", "blend")
        if control.is_holding:  # also a command that was ready too late is answered with a hold
            self._executed.begin()
        acting = Acting(
            who=who,
            moved=self._executed.displacement() if is_led else (),
            gripper_open=row.gripper_open if is_led and row is not None else None,
            session="" if row is None else row.session,
            number=0 if row is None else row.number,
            share=1.0 if limited is None else limited.share,
            limits="" if limited is None else ",".join(limited.acted),
            note=note,
        )
        self._acting.publish(acting.to_message())
        control.status.set_value("acting", who)


_AGAIN = "the lead was silent: release the switch and press it again"


def twist_in_base(row: LeadRow, rotation: F64) -> F64:
    """Return the twist of a row in the base frame, float64 (6,) [m/s, rad/s].

    Args:
        row: a row of kind "twist".
        rotation: rotation of the TCP in the base, float64 (3, 3).
    """
    if row.keys == ("base",):
        return row.values
    return np.concatenate([rotation @ row.values[:3], rotation @ row.values[3:]])


def space_row(space: ControlSpace, row: LeadRow, joints: JointSample) -> F64:
    """Convert to a row of the robot's own space; joints that the lead does not name stand still.

    Raises:
        InvalidInputError: it names a joint that does not belong to the arm.
    """
    named = dict(zip(row.keys, row.values.tolist(), strict=True))
    unknown = sorted(set(named) - {channel.name for channel in space.channels})
    if unknown:
        raise InvalidInputError(f"{', '.join(unknown)} are no joints of the arm that is led.")
    still = (
        {}
        if space.kind == "joint_velocity"
        else dict(zip(joints.names, joints.position.tolist(), strict=False))
    )
    opening = 0.0 if row.gripper_open is None else row.gripper_open
    return np.array(
        [
            opening
            if channel.name == GRIPPER
            else named.get(channel.name, still.get(channel.name, 0.0))
            for channel in space.channels
        ]
    )
