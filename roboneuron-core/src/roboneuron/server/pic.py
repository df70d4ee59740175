"""The closed-loop tools (perception, inference, control): what the agent reads, around `ClosedLoop`."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from roboneuron.modules.settings import MODULE_KINDS, ModuleKind
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import InstructionResult, StopAllResult, StopResult, stop_result
from roboneuron.server.start_tools import MAX_INSTRUCTION_LENGTH, start_tools
from roboneuron.server.switch_tools import switch_tools
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
        *switch_tools(loop),
        *(_stop_tool(loop, kind) for kind in MODULE_KINDS),
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


def _stop_tool(loop: ClosedLoop, kind: ModuleKind) -> Tool[Any]:
    effect = {
        "robot": "the driver holds the robot and disconnects",
        "perception": "the cameras are closed; actions cease when images do",
        "inference": "no more actions; the arm holds",
        "control": "the arm holds; no more joint commands",
    }[kind]

    async def handler(_: NoArguments, context: CallContext) -> StopResult:
        return stop_result(kind, await context.run(lambda _: loop.stop(kind)))

    return Tool(
        name=f"stop_{kind}",
        title=f"Stop {kind}",
        description=f"Stop {kind}: {effect}. Returns when its process is gone; also cancels a start in progress. "
        "An error if it does not run.",
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
