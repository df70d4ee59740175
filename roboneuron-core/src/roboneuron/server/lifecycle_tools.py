"""The tools that start, instruct and stop the modules of the closed loop."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.module_kinds import KINDS, KindEntry
from roboneuron.server.requests import MAX_INSTRUCTION_LENGTH
from roboneuron.server.results import InstructionResult, StopAllResult, StopResult, stop_result
from roboneuron.server.start_tools import start_tools
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Tool


class SetInstruction(Arguments):
    """Arguments of set_instruction."""

    instruction: str = Field(
        max_length=MAX_INSTRUCTION_LENGTH, description='What to do, for instance "pick up the red cube".'
    )
    timeout_s: float = Field(
        default=30.0, gt=0, le=600, description="How long to wait for the first action, in seconds."
    )


def closed_loop_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """All tools of the closed loop, in the order in which an agent uses them."""
    return [
        *start_tools(loop),
        _set_instruction(loop),
        *(_stop_tool(loop, KINDS[kind]) for kind in MODULE_KINDS),
        _stop_all(loop),
    ]


def _set_instruction(loop: ClosedLoop) -> Tool[Any]:
    async def set_instruction(arguments: SetInstruction, context: CallContext) -> InstructionResult:
        report, took_s = await context.run(lambda _: loop.set_instruction(arguments.instruction, arguments.timeout_s))
        return InstructionResult(instruction=report.instruction, took_s=round(took_s, 3), note=report.note)

    return Tool(
        name="set_instruction",
        title="Tell the robot what to do",
        description=(
            "Give the running backend a new instruction, without a restart. Returns when its first action for it "
            "was published: the robot is moving then, not done; watch get_status and get_camera_image. If the "
            "backend cannot act on the instruction, its reason is the error and nothing moves."
        ),
        arguments=SetInstruction,
        result=InstructionResult,
        handler=set_instruction,
        open_world=True,
    )


def _stop_tool(loop: ClosedLoop, entry: KindEntry) -> Tool[Any]:
    kind = entry.kind

    async def handler(_: NoArguments, context: CallContext) -> StopResult:
        return stop_result(kind, await context.run(lambda _: loop.stop(kind)))

    return Tool(
        name=f"stop_{kind}",
        title=f"Stop {kind}",
        description=f"Stop {kind}: {entry.stop_text}. Returns when its process is gone; also cancels a start in "
        "progress. An error if it does not run.",
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
        description="Stop all modules in the reverse order of their start. Returns when all processes are gone.",
        arguments=NoArguments,
        result=StopAllResult,
        handler=handler,
        destructive=True,
        idempotent=True,
        open_world=True,
        always=True,
    )
