"""The feature with the tool stop_motion: ends whatever moves, latches nothing, and says how the
robot stands.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence

from pydantic import Field

from roboneuron.contract import JointSample
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import NotReadyError, RoboNeuronError, StateError
from roboneuron.gate import Role
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, MotionGate
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool
from roboneuron.tools.arm.feature import ArmTools
from roboneuron.tools.arm.joint_rest import JointRest
from roboneuron.tools.arm.plugin import FEATURE as ARM

_END_S = 2.0
"""Longest wait for the end of each motion, and for rest."""
_MEASURED_S = 0.5
_POLL_S = 0.01


class StopMotionFeature(Feature[None]):
    """Adds stop_motion."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        return [stop_motion_tool(host)]


class StandingArm(Result):
    """An arm after the stop."""

    sparse = True

    arm: str = Field(default="", description="which of several arms")
    position_m: list[float] = Field(
        default_factory=list, description="measured TCP, base frame; empty: not measured"
    )
    down_deg: float | None = Field(
        default=None, description="angle of the hand's axis to straight down [deg]"
    )
    holding: bool | None = Field(default=None, description="it holds something; null: unknown")


class StopMotionResult(Result):
    """What was stopped, and how the robot stands."""

    sparse = True

    stopped: list[str] = Field(description="what moved it; empty: nothing did")
    at_rest: bool | None = Field(description="by measured joints; null: not measured")
    took_s: float = Field(description="from the call until it was measured at rest")
    arms: list[StandingArm] = Field(default_factory=list)
    joints: dict[str, float] = Field(default_factory=dict, description="measured [rad or m]")
    go_on: str = Field(description="the call that would go on; nothing resumes by itself")


class MotionStop:
    """The handler of stop_motion, for one robot."""

    def __init__(self, host: Host) -> None:
        self._host = host

    async def __call__(self, _: NoArguments, context: CallContext) -> StopMotionResult:
        """Raises NotReadyError if a module does not confirm the stop, or a motion does not end."""
        return await context.run(lambda _: self.stop(context))

    def stop(self, context: CallContext) -> StopMotionResult:
        """End all motion of this robot; blocks. Raises NotReadyError."""
        began_s = time.monotonic()
        host = self._host
        motions, instruction = host.motions, host.loop.starts.instruction
        called = ", ".join(self._called())
        reason = f"{context.who} called stop_motion"
        failures: dict[str, str] = dict(host.loop.starts.stop_motion(reason).items())
        if not host.loop.starts.claims.end_all(reason, _END_S):
            failures["server"] = f"a motion did not end within {_END_S:g} s"
        self._check(failures)
        at_rest, joints = self._await_rest(self._gate())
        took_s = time.monotonic() - began_s
        return StopMotionResult(
            stopped=[
                f"{called}: {one}" if called and not one.startswith(called) else one
                for one in motions
            ],
            at_rest=at_rest,
            took_s=round(took_s, 3),
            arms=self._arms(),
            joints=_by_name(joints),
            go_on=self._go_on(context, motions, called, instruction),
        )

    def _called(self) -> list[str]:
        """Tools that are called now and may move the robot: one may move it by another."""
        running = self._host.tools.chain.running.copy().values()
        acting = [one for one in running if one.tool.simulated_by and not one.context.simulated]
        return list(dict.fromkeys(one.name for one in acting))

    def _go_on(
        self, asker: CallContext, motions: tuple[str, ...], called: str, instruction: str
    ) -> str:
        """What goes on with the motion that was stopped, after what has to be done first; `called`
        are the tools that were called for it.
        """
        call = "Nothing moved: any call may move the robot."
        if instruction:
            call = f"Call run_task, or set_instruction, with the instruction {instruction!r}."
        elif motions:
            stopped = called or motions[0].split(" ")[0]
            call = f"Call again what was stopped ({stopped}), with what is left of it."
        for reason in self._host.why_still(asker):
            if reason.rank != "start":  # that is this stop
                return f"{reason} Then: {call}" if motions or instruction else str(reason)
        return call

    def _gate(self) -> MotionGate | None:
        try:
            return self._host.gate
        except StateError:  # without one, only policies move the robot
            return None

    def _check(self, failures: Mapping[str, str]) -> None:
        told = [f"{kind}: {text}" for kind, text in failures.items() if text]
        if told:
            raise NotReadyError(
                f"The stop is not confirmed by {'; '.join(told)}.",
                hint="Call emergency_stop if the robot moves; see get_status.",
            )

    def _await_rest(self, gate: MotionGate | None) -> tuple[bool | None, JointSample | None]:
        """Wait until the joints rest; returns whether they do, and where they are."""
        exposed = None if gate is None else self._joint_endpoint(gate)
        if gate is None or exposed is None or exposed.profile is None:
            return None, None
        joints = gate.joints(exposed, _MEASURED_S)
        if joints is None:
            return None, None
        rest = JointRest(joints.names, exposed.profile.kinds)
        deadline_s = time.monotonic() + _END_S
        while time.monotonic() < deadline_s:
            newest = gate.newest_joints(exposed)
            if newest is not None:
                joints = newest
                if rest.note(newest, time.monotonic()):
                    return True, newest
            time.sleep(_POLL_S)
        return False, joints

    def _joint_endpoint(self, gate: MotionGate) -> ExposedEndpoint | None:
        name = self._host.config.robot.name
        if self._host.modules.view("robot").phase != "running":
            return None
        return next((e for e in gate.exposed if e.robot == name and e.profile is not None), None)

    def _arms(self) -> list[StandingArm]:
        feature = self._host.features.loaded.get(ARM.name)
        if not isinstance(feature, ArmTools):
            return []
        return [self._arm(feature, key) for key in feature.poses if self._is_own(key)]

    def _is_own(self, key: str) -> bool:
        return key.split("/")[0] == self._host.config.namespace

    def _arm(self, feature: ArmTools, key: str) -> StandingArm:
        facts: dict[str, object] = {}
        try:
            pose = feature.poses[key].wait(_MEASURED_S)
        except RoboNeuronError:  # control does not run: the joints tell where the arm is
            pass
        else:
            facts["position_m"] = [round(float(one), 4) for one in pose.position_m]
            axis = matrix_from_quaternion(pose.quaternion_xyzw)[:, 2]
            facts["down_deg"] = _angle_to_down(float(axis[2]))
        if (grip := feature.grips.get(key)) is not None:
            facts["holding"] = grip.holding()
        return StandingArm.model_validate({"arm": key.partition("/")[2], **facts})


def _angle_to_down(z: float) -> float:
    """Angle between a unit vector with this z, and straight down [deg]."""
    return round(math.degrees(math.acos(max(-1.0, min(1.0, -z)))), 1)


def _by_name(joints: JointSample | None) -> dict[str, float]:
    if joints is None:
        return {}
    return {
        name: round(float(value), 4)
        for name, value in zip(joints.names, joints.position, strict=True)
    }


def stop_motion_tool(host: Host) -> Tool[NoArguments]:
    """stop_motion."""
    return Tool(
        name="stop_motion",
        title="Stop moving",
        description="End whatever moves the robot (a tool, a policy or task, a goal, a lead) and "
        "say how it stands. Nothing is latched and no module stops: the next call may move it.",
        arguments=NoArguments,
        result=StopMotionResult,
        handler=MotionStop(host),
        destructive=True,
        idempotent=True,
        open_world=True,
        role=Role.VIEWER,  # every role that sees the robot may stop it
        always=True,
    )
