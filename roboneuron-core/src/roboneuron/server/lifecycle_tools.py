"""The tools that start, instruct and stop the modules of the closed loop, and the emergency stop
and its reset.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

from pydantic import Field

from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.estop.emergency import reset_command
from roboneuron.estop.pin import ReleasePin
from roboneuron.gate.roles import ADMIN, VIEWER
from roboneuron.modules.settings import MAX_INSTRUCTION_LENGTH, MODULE_KINDS
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import (
    EmergencyStopResult,
    InstructionResult,
    StartResult,
    StopAllResult,
    StopResult,
    stop_result,
)
from roboneuron.server.selection import KIND_ENTRIES, KindEntry
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Tool


class SetInstruction(Arguments):
    """Arguments of set_instruction."""

    instruction: str = Field(
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube".',
    )
    timeout_s: float = Field(
        default=30.0, gt=0, le=600, description="How long to wait for the first action, in seconds."
    )


def closed_loop_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """All tools of the closed loop, in the order in which an agent uses them."""
    return [
        *(_start_tool(loop, entry) for entry in KIND_ENTRIES.values()),
        _set_instruction(loop),
        *(_stop_tool(loop, KIND_ENTRIES[kind]) for kind in MODULE_KINDS),
        _stop_all(loop),
    ]


def _set_instruction(loop: ClosedLoop) -> Tool[Any]:
    async def set_instruction(arguments: SetInstruction, context: CallContext) -> InstructionResult:
        report, took_s = await context.run(
            lambda _: loop.set_instruction(arguments.instruction, arguments.timeout_s)
        )
        return InstructionResult(
            instruction=report.instruction, took_s=round(took_s, 3), note=report.note
        )

    return Tool(
        name="set_instruction",
        title="Tell the robot what to do",
        description=(
            "Give the running policy an instruction. Returns at its first action, not at the end "
            "of the task; stop_inference ends the motion. If the policy cannot act on the "
            "instruction, "
            "the error says why "
            "and nothing moves."
        ),
        arguments=SetInstruction,
        result=InstructionResult,
        handler=set_instruction,
        open_world=True,
        offered=loop.takes_policies,
    )


def _stop_tool(loop: ClosedLoop, entry: KindEntry) -> Tool[Any]:
    kind = entry.kind

    async def handler(_: NoArguments, context: CallContext) -> StopResult:
        return stop_result(kind, await context.run(lambda _: loop.stop(kind)))

    return Tool(
        name=f"stop_{kind}",
        title=f"Stop {kind}",
        description=f"{entry.stop_text} Returns when its process is gone. Also ends a start in "
        "progress.",
        offered=loop.takes_policies if kind == "inference" else lambda: True,
        arguments=NoArguments,
        result=StopResult,
        handler=handler,
        destructive=True,
        open_world=True,
        always=True,
    )


def _stop_all(loop: ClosedLoop) -> Tool[Any]:
    async def handler(_: NoArguments, context: CallContext) -> StopAllResult:
        stopped = await context.run(lambda _: loop.stop_all())
        return StopAllResult(stopped=[stop_result(s.kind, s) for s in stopped])

    return Tool(
        name="stop_all",
        title="Stop everything",
        description="Stop all modules in the reverse order of their start. Returns when all "
        "processes are gone.",
        arguments=NoArguments,
        result=StopAllResult,
        handler=handler,
        destructive=True,
        idempotent=True,
        open_world=True,
        always=True,
    )


def _start_tool(loop: ClosedLoop, entry: KindEntry) -> Tool[Any]:
    which = f" The configured one is the {loop.robot_facts}." if entry.kind == "robot" else ""

    async def handler(request: Arguments, context: CallContext) -> StartResult:
        started_s = time.monotonic()
        view = await context.run(
            lambda stage: loop.start(entry.kind, request, stage, context.role),
            on_cancel=lambda: loop.cancel(entry.kind),
        )
        return StartResult.short_of(view, took_s=round(time.monotonic() - started_s, 3))

    return Tool(
        name=f"start_{entry.kind}",
        title=entry.title,
        description=f"{entry.start_text}{which} Returns when {entry.proof}; if it fails, nothing "
        "is left running.",
        offered=loop.takes_policies if entry.kind == "inference" else lambda: True,
        arguments=entry.request,
        result=StartResult,
        handler=handler,
        open_world=True,
    )


class EmergencyStopArguments(Arguments):
    """Arguments of emergency_stop."""

    reason: str = Field(
        default="", max_length=500, description="Why; kept in the latch and in the audit."
    )


def emergency_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """emergency_stop and reset_emergency_stop."""
    stop = loop.emergency_stop

    def press(arguments: Mapping[str, Any], context: CallContext) -> None:
        """Latch before anything else: also when ROS is not joined yet, and when the arguments are
        wrong.
        """
        with suppress(UnsafeError):  # told by the call itself, which tries again
            stop.file.press(who=context.who, reason=str(arguments.get("reason") or ""))

    async def ask_person(context: CallContext, *, for_pin: bool) -> str:
        """The PIN that a person has typed; raises RefusedError unless one agreed to release this
        very stop.
        """
        before, cause = stop.file.read_state(), stop.cause()
        since = (
            datetime.fromtimestamp(min(max(before.time_ns, 0), 2**62) / 1e9, UTC)
            .astimezone()
            .isoformat(" ", "milliseconds")
        )
        question = (  # the time makes a question about another stop another question
            f"The emergency stop is latched since {since}{f' by {cause}' if cause else ''}. "
            "Release it? "
            "Look at the robot first. Nothing moves until someone gives a new instruction or "
            "moves the arm."
        )
        typed = await context.ask_for(question, "PIN") if for_pin else ""
        agreed = (
            (None if typed is None else bool(typed)) if for_pin else await context.ask(question)
        )
        if agreed and stop.file.read_state().time_ns == before.time_ns:
            return typed or ""
        why = {None: "this client cannot ask one", False: "the person did not agree"}.get(
            agreed, "it was pressed again"
        )
        raise RefusedError(
            f"Only a person releases the emergency stop, and {why}. It stays latched.",
            hint="Ask a person to look at the robot and to run, in a terminal on this machine: "
            f"{reset_command(stop.file.path.parent)}",
        )

    async def latch(arguments: EmergencyStopArguments, context: CallContext) -> EmergencyStopResult:
        confirmed, took_s = await context.run(
            lambda _: stop.latch(loop.config.namespace, who=context.who, reason=arguments.reason)
        )
        note = (
            ""
            if confirmed
            else "No module runs; those that are started later are stopped from the beginning."
        )
        return EmergencyStopResult(
            latched=True, confirmed_by=confirmed, took_s=round(took_s, 3), note=note
        )

    async def reset(_: NoArguments, context: CallContext) -> EmergencyStopResult:
        who, pin = context.who, ""
        for_pin = ReleasePin(stop.file.path.parent).is_set
        if (for_pin or loop.base.server.reset_emergency_stop == "person") and stop.is_latched():
            pin = await ask_person(context, for_pin=for_pin)
            who = f"a person asked by {who}"
        confirmed, took_s = await context.run(
            lambda _: stop.reset(loop.config.namespace, who=who, role=context.role, pin=pin)
        )
        return EmergencyStopResult(
            latched=False, confirmed_by=confirmed, took_s=round(took_s, 3), note=loop.starts.AGAIN
        )

    return [
        Tool(
            name="emergency_stop",
            title="Emergency stop",
            description=(
                "For danger: stop all motion at once. Nothing moves until a person releases it, "
                "even after restarts. For an ordinary stop use stop_inference or stop_all. "
                "Returns when "
                "every running module "
                "has confirmed it; an error names those that have not."
            ),
            arguments=EmergencyStopArguments,
            result=EmergencyStopResult,
            handler=latch,
            destructive=True,
            idempotent=True,
            open_world=True,
            role=VIEWER,  # whoever sees the robot may stop it
            always=True,
            urgent=press,
        ),
        Tool(
            name="reset_emergency_stop",
            title="Release the emergency stop",
            description=(
                "Release the emergency stop. A person must agree: the client asks, if it can; "
                "otherwise the call is refused and says what a person has to do. Nothing moves "
                "by itself: the policy "
                "has forgotten its "
                "instruction; set_instruction or run_task starts it again."
            ),
            arguments=NoArguments,
            result=EmergencyStopResult,
            handler=reset,
            destructive=True,
            idempotent=True,
            open_world=True,
            role=ADMIN,
        ),
    ]
