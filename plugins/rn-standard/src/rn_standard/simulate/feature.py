"""The feature: calls that move the arm, carried out by a twin instead."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from rn_standard.simulate.arm import TooLongError, TwinArm
from rn_standard.simulate.options import SimulateOptions
from rn_standard.simulate.results import Outcome, Simulated, Survey
from rn_standard.simulate.session import EndedError, Session, arm_endpoint
from rn_standard.simulate.task import policy_of
from rn_standard.simulate.twin import Twin, driver_of, has_twin, scene_of
from rn_standard.simulate.twin_process import TwinProcess
from rn_standard.tasks.moving import MoveToArguments
from rn_standard.tasks.run_task import RunTask
from roboneuron import (
    Arguments,
    CallContext,
    Feature,
    Host,
    InvalidInputError,
    NotReadyError,
    Picture,
    RefusedError,
    Reply,
    RoboNeuronError,
    RobotProfile,
    Tool,
)
from roboneuron.feature import AuditRecord, Role, Simulator
from roboneuron.server.rehearsal import Rehearsable
from roboneuron.tools.arm.prediction import ArmControl

NAME = "simulate"
_JOINTS_S = 2.0
_START_S = 30.0
"""Longest start of the process, which imports a physics engine."""
_GRACE_S = 3.0
"""So much later than the simulation's own bound a twin that does not answer is killed."""
_SIZE_PX = (320, 240)


class SimulateArguments(Arguments):
    """Arguments of simulate."""

    tool: str
    arguments: dict[str, object]


class SimulateFeature(Feature[SimulateOptions]):
    """Answers calls with simulate=true from a twin of the cell. It sends nothing, and has no
    publisher.
    """

    _process: TwinProcess | None = None

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """One tool that is not listed: calls come to it by `simulator`."""
        self._host = host
        # one simulation at a time: they share the twin
        self._one = threading.Lock()
        return [
            Tool(
                name=NAME,
                title="Simulate a motion",
                description="What a call that moves the arm would do, in a simulated twin.",
                arguments=SimulateArguments,
                result=Simulated,
                handler=self._simulate,
                read_only=True,
                idempotent=True,
                listed=False,
            )
        ]

    def simulator(self, host: Host) -> Simulator:
        """See `Feature.simulator`."""
        return Simulator(tool=NAME, is_there=lambda: has_twin(host))

    def close(self) -> None:
        """End the process of the twin."""
        if self._process is not None:
            self._process.end()
            self._process = None

    async def _simulate(self, arguments: SimulateArguments, context: CallContext) -> Reply:
        """Raises InvalidInputError, NotReadyError, RefusedError."""
        tool = self._host.tools.get(arguments.tool)
        if tool is None or "twin" not in tool.simulated_by:
            raise InvalidInputError(f"{arguments.tool[:64]!r} cannot be simulated.", path="tool")
        parsed = tool.parsed(arguments.arguments)
        if isinstance(parsed, RunTask):
            policy_of(self._host)
        reply = await context.run(lambda _: self._work(tool, parsed, context))
        self._note(arguments, reply.result, context)
        return reply

    def _work(self, tool: Tool[Any], parsed: object, context: CallContext) -> Reply:
        began_s = time.monotonic()
        if not self._one.acquire(timeout=self.options.limit_s):
            raise NotReadyError("Another simulation takes all the time.", hint="Call again.")
        try:
            return self._in_twin(tool, parsed, context, began_s)
        finally:
            self._one.release()

    def _in_twin(
        self,
        tool: Tool[Any],
        parsed: object,
        context: CallContext,
        began_s: float,
    ) -> Reply:
        host = self._host
        exposed = arm_endpoint(host)
        profile = exposed.profile
        assert profile is not None
        joints = host.gate.joints(exposed, _JOINTS_S)
        if joints is None:
            raise NotReadyError("The joints are not measured.", hint="Call start_robot first.")
        with ExitStack() as open_:
            control = ArmControl.of(host, exposed)
            open_.callback(control.close)
            twin = self._twin(profile)
            scene = scene_of(host, twin) if self.options.objects else None
            if scene is None and "scene" in _needs_of(tool, parsed):
                raise RefusedError(
                    f"{tool.name} can be simulated in a simulated cell that runs: elsewhere it is "
                    "not known what stands where.",
                    hint="Simulate single motions: move_ee, move_joints, move_to.",
                    rule=NAME,
                )
            open_.callback(twin.close)
            twin.open(joints, scene)
            survey = Survey(control.rules, control.controller)
            end_s = time.monotonic() + self.options.limit_s
            twin.end_s = end_s + _GRACE_S
            arm = TwinArm(twin, control, survey, end_s)
            session = Session(host, exposed.namespace, control, arm, twin, context)
            outcome, rule, reason = self._ended(session, tool, parsed)
            names = [part.name for part in control.profile.each_arm]
            named = getattr(parsed, "arm", "")
            pose = arm.poses()[names.index(named) if named in names else 0]
            there = twin.joints()
            result = Simulated(
                tool=tool.name,
                allowed=outcome == "reached",
                outcome=outcome,
                rule=rule,
                reason=reason,
                limits=dict(survey.limits),
                would_move=list(twin.moved()),
                nearest=survey.nearest(),
                duration_s=round(arm.passed_s - arm.rested_s, 2),
                position_m=[round(value, 5) for value in pose.position_m.tolist()],
                quaternion_xyzw=[round(value, 5) for value in pose.quaternion_xyzw.tolist()],
                joints={
                    name: round(value, 5)
                    for name, value in zip(there.names, there.position.tolist(), strict=True)
                },
                now=self._why_not_now(tool, parsed, context),
                took_s=round(time.monotonic() - began_s, 3),
            )
            return Reply(result=result, pictures=self._pictures(twin))

    def _ended(self, session: Session, tool: Tool[Any], parsed: object) -> tuple[Outcome, str, str]:
        """Carry out the call; return its outcome, and the rule and the reason that ended it."""
        try:
            session.call(tool, parsed)
        except EndedError as error:
            return error.outcome, error.rule, str(error)
        except TooLongError:
            reason = (
                f"The simulation took longer than {self.options.limit_s:g} s; it has come to "
                f"{session.arm.passed_s:.1f} s of the motion."
            )
            return "unclear", "", reason
        return "reached", "", ""

    def _twin(self, profile: RobotProfile) -> TwinProcess:
        """The process of the last simulation, or another one. Raises NotReadyError."""
        spec, options = driver_of(self._host)
        last = self._process
        if last is not None and last.is_alive and last.key == (spec, repr(options)):
            last.end_s = time.monotonic() + _START_S
            return last
        if last is not None:
            last.end()
        self._process = TwinProcess(spec, options, profile, time.monotonic() + _START_S)
        return self._process

    def _pictures(self, twin: Twin) -> tuple[Picture, ...]:
        """The scene at the end, by the first camera."""
        camera = next(iter(self._host.loop.camera_roles()), None)
        if camera is None:
            return ()
        return (_png(twin.picture(camera, *_SIZE_PX)),)

    def _why_not_now(self, tool: Tool[Any], parsed: object, context: CallContext) -> str:
        """Why the call itself would be refused; empty when nothing is known that speaks against
        it.
        """
        host = self._host
        if not tool.least_role.is_held_by(context.role):
            return f"It needs the role {Role.OPERATOR!r}."
        try:
            host.loop.emergency_stop.check()
            if isinstance(parsed, RunTask):
                with host.loop.starts.claims.admit(parsed.instruction):
                    return ""
            host.gate.check_free(arm_endpoint(host))
            if "control" in _needs_of(tool, parsed):
                host.modules.require_running("control")
        except RoboNeuronError as error:
            return str(error)
        return ""

    def _note(self, arguments: SimulateArguments, result: object, context: CallContext) -> None:
        """Write it down; a full disk keeps nobody from looking."""
        assert isinstance(result, Simulated)
        record = AuditRecord(
            who=context.who,
            role=context.role,
            tool=arguments.tool[:200],
            robot=self._host.config.robot.name,
            verdict="would_allow" if result.outcome == "reached" else "would_refuse",
            rule=result.rule,
            reason=f"simulated: {result.outcome}. {result.reason}"[:500],
            arguments=arguments.arguments,
        )
        with suppress(RefusedError):
            self._host.audit.write(record)


def _needs_of(tool: Tool[Any], parsed: object) -> frozenset[str]:
    """See `Rehearsable.rehearsal_needs`."""
    if isinstance(parsed, MoveToArguments):
        return frozenset()
    if isinstance(parsed, RunTask):
        return frozenset({"scene"})
    return cast("Rehearsable", tool.handler).rehearsal_needs


def _png(image: NDArray[np.uint8]) -> Picture:
    from PIL import Image as Pillow  # heavy

    buffer = io.BytesIO()
    Pillow.fromarray(image).save(buffer, "PNG", compress_level=6)
    return Picture(data=buffer.getvalue(), mime_type="image/png")
