"""One simulation: the calls of the arm's tools, carried out in a twin."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

import numpy as np

from rn_standard.simulate.arm import TwinArm
from rn_standard.simulate.results import Outcome
from rn_standard.simulate.task import run_in_twin
from rn_standard.simulate.twin_process import TwinProcess
from rn_standard.tasks.moving import JudgesPath, Mover, MoveToArguments
from rn_standard.tasks.named_targets import Places
from rn_standard.tasks.run_task import RunTask, TaskTool
from roboneuron import (
    F64,
    CallContext,
    Host,
    NotReadyError,
    RefusedError,
    StateError,
    Tool,
    matrix_from_quaternion,
)
from roboneuron.feature import ExposedEndpoint, Stage
from roboneuron.server.rehearsal import Rehearsable, Rehearsal
from roboneuron.tools.arm.prediction import ArmControl

T = TypeVar("T")


class EndedError(Exception):
    """The motion would not come to its end."""

    def __init__(self, outcome: Outcome, rule: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome, self.rule = outcome, rule


class _Inline:
    """A CallContext for what runs on the thread of the simulation already."""

    simulated = True

    def __init__(self, context: CallContext) -> None:
        self.who, self.role = context.who, context.role

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        return work(lambda _: None)

    async def ask(self, question: str, what: str = "") -> str | None:
        return None


class Session:
    """Carries out calls one after the other, from where the one before has ended; one thread.
    Follows the protocol `Rehearsal`.

    Attributes:
        arm: of the twin.
        namespace: of the robot.
        context: of the call, on this thread.
    """

    def __init__(
        self,
        host: Host,
        namespace: str,
        control: ArmControl,
        arm: TwinArm,
        twin: TwinProcess,
        context: CallContext,
    ) -> None:
        """Args:
        host: of the feature.
        namespace: of the robot.
        control: of the arm.
        arm: of the twin.
        twin: that of the arm.
        context: of the call.
        """
        self._host, self._control, self._twin = host, control, twin
        self.arm, self.namespace = arm, namespace
        self.context = cast("CallContext", _Inline(context))

    def call(self, tool: Tool[Any], arguments: object) -> None:
        """Carry out a call. Raises EndedError when it does not come to its end, and what the tool
        raises for a call that makes no sense.
        """
        if isinstance(arguments, MoveToArguments):
            self._move_to(arguments)
            return
        if isinstance(arguments, RunTask):
            self._run_task(cast("TaskTool", tool.handler), arguments)
            return
        began_s = self.arm.passed_s
        try:
            cast("Rehearsable", tool.handler).rehearse(arguments, self)
        except RefusedError as error:
            if self.arm.passed_s == began_s:
                raise _refused(error) from error
            raise EndedError(self._stopped(), self.arm.rule or error.rule, error.message) from error
        except StateError as error:
            self.arm.settle()
            raise EndedError("stopped", "lost", error.message) from error

    def _stopped(self) -> Outcome:
        """The outcome of a motion that has ended before its end."""
        held = bool(self.arm.held)
        self.arm.settle()
        return "blocked" if self._twin.moved() and not held else "stopped"

    def check(self, messages: Sequence[object]) -> None:
        """See `Rehearsal`."""
        self._control.path(messages, self.arm.joints())

    def play(self, messages: Sequence[object]) -> None:
        """See `Rehearsal`. Raises EndedError if the joints do not get to the end."""
        if not self.arm.play(self._control.path(messages, self.arm.joints())):
            reason = "The joints do not come to the end of the way."
            raise EndedError("blocked" if self._twin.moved() else "stopped", "path", reason)

    def check_path(
        self,
        steps: Sequence[Mapping[str, float]],
        context: CallContext,
        rehearsal: Rehearsal | None = None,
    ) -> None:
        """See `JudgesPath`; raises EndedError for a path that is refused."""
        tool = self._host.tools.get("move_joints")
        if tool is None:
            return  # the call says so
        try:
            cast("JudgesPath", tool.handler).check_path(steps, context, self)
        except RefusedError as error:
            raise _refused(error) from error

    def _move_to(self, arguments: MoveToArguments) -> None:
        tasks = self._host.features.loaded["tasks"]
        places = Places(self._host, tasks.options)
        mover = Mover(self._host, places, self._pose_now, self._call_by_name, judge=self)
        if arguments.name is not None:  # at the usual speed: a slower one takes the same path
            arguments = arguments.model_copy(update={"speed": 1.0})
        asyncio.run(_go(mover, arguments, self.context))

    def _run_task(self, handler: TaskTool, arguments: RunTask) -> None:
        """The task's own rules; what is done after its end is not looked at."""
        judge, plan = handler.rehearsal(arguments, self._control.profile)
        end = run_in_twin(self._host, self.arm, self._twin, self._control.profile, judge, plan)
        if end.outcome != "succeeded":
            outcome: Outcome = "unclear" if end.outcome == "unclear" else "stopped"
            raise EndedError(outcome, end.outcome.value, f"{end.reason.rstrip('.')}.")

    async def _call_by_name(
        self, name: str, arguments: Mapping[str, object], _: CallContext
    ) -> dict[str, Any]:
        tool = self._host.tools.get(name)
        if tool is None:
            raise NotReadyError(
                f"There is no tool {name} now.", hint="It comes with rn-tools-arm and an arm."
            )
        began_s = self.arm.passed_s
        self.call(tool, tool.parsed(arguments))
        return {"duration_s": self.arm.passed_s - began_s, "error": 0.0}

    def _pose_now(self, arm: str) -> tuple[F64, F64]:
        names = [part.name for part in self._control.profile.each_arm]
        pose = self.arm.poses()[names.index(arm)]
        return np.array(pose.position_m), matrix_from_quaternion(pose.quaternion_xyzw)


async def _go(mover: Mover, arguments: MoveToArguments, context: CallContext) -> None:
    await mover.go(arguments, context)


def arm_endpoint(host: Host) -> ExposedEndpoint:
    """An endpoint of the present arm. Raises NotReadyError."""
    found = next(
        (
            one
            for one in host.gate.exposed
            if one.robot == host.config.robot.name
            and one.profile is not None
            and one.profile.tcp_link
        ),
        None,
    )
    if found is None:
        raise NotReadyError("There is no arm here whose motion could be simulated.")
    return found


def _refused(error: RefusedError) -> EndedError:
    return EndedError("refused", error.rule, str(error))
