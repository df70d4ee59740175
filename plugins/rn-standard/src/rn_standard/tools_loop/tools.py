"""The tools that start and instruct the modules of the closed loop; those that stop are core's."""

from __future__ import annotations

import time
from typing import Any

from pydantic import Field

from rn_standard.tools_loop.results import InstructionResult, StartResult
from roboneuron import Arguments, CallContext, Tool
from roboneuron.feature import KIND_ENTRIES, ClosedLoop, KindEntry, settings


class SetInstruction(Arguments):
    """Arguments of set_instruction."""

    instruction: str = Field(
        max_length=settings.MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube".',
    )
    timeout_s: float = Field(
        default=30.0, gt=0, le=600, description="How long to wait for the first action, in seconds."
    )


def start_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """A tool for each kind of module, and set_instruction, in the order in which an agent uses
    them.
    """
    return [*(_start_tool(loop, entry) for entry in KIND_ENTRIES.values()), _set_instruction(loop)]


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
