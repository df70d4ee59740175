"""The tools that start, instruct and stop the modules of the closed loop."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from pydantic import Field

from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.module_kinds import KINDS, MAX_INSTRUCTION_LENGTH, KindEntry
from roboneuron.server.results import (
    InstructionResult,
    StartResult,
    StopAllResult,
    StopResult,
    module_summary,
    stop_result,
)
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


def start_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """One for each kind of module, in their usual order."""
    return [_start_tool(loop, entry) for entry in KINDS.values()]


def plugin_choices(loop: ClosedLoop, entry: KindEntry) -> dict[str, Callable[[], dict[str, str]]]:
    """The plugins that the arguments of a kind's tools can name."""
    return {argument: partial(loop.plugins.choices, kind) for argument, kind in entry.choices.items()}


def _start_tool(loop: ClosedLoop, entry: KindEntry) -> Tool[Any]:
    async def handler(request: Arguments, context: CallContext) -> StartResult:
        started_s = time.monotonic()
        view = await context.run(
            lambda stage: loop.start(entry.kind, request, stage, context.role),
            on_cancel=lambda: loop.cancel(entry.kind),
        )
        return StartResult(**module_summary(view), took_s=round(time.monotonic() - started_s, 3))

    return Tool(
        name=f"start_{entry.kind}",
        title=entry.title,
        description=f"{entry.start_text} Returns when it works ({entry.proof}); on any failure nothing is left "
        "running. An error if it already runs.",
        arguments=entry.request,
        result=StartResult,
        handler=handler,
        open_world=True,
        choices=plugin_choices(loop, entry),
    )
