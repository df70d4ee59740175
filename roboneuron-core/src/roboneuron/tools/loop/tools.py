"""Tools that start and instruct the modules of the closed loop; the stop tools belong to core."""

from __future__ import annotations

import threading
import time

from pydantic import Field

from roboneuron.config.models import Config
from roboneuron.modules.inference.instruction_text import InstructionText
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES, Plan
from roboneuron.plugins.registry import Registry
from roboneuron.server.loop import ClosedLoop, StartForm
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Tool
from roboneuron.tools.loop.instructing import give_instruction
from roboneuron.tools.loop.results import InstructionResult, StartResult


class SetInstruction(Arguments):
    """Arguments of set_instruction."""

    instruction: InstructionText = Field(
        description='What to do, for instance "pick up the red cube".',
    )
    timeout_s: float = Field(
        default=30.0, gt=0, le=600, description="Timeout of the first action [s]."
    )


class StartInference(Arguments):
    """Arguments of start_inference."""

    instruction: InstructionText | None = Field(
        default=None,
        description='What to do at once, such as "pick up the red cube"; set_instruction gives '
        "one later.",
    )


def plan_instruction(
    kind: ModuleKind, config: Config, registry: Registry, request: Arguments, role: str
) -> Plan:
    """Plan the configured policy with the instruction of a request, see `StartForm.plan`."""
    entry = KIND_ENTRIES[kind]
    instruction = getattr(request, "instruction", None)
    if instruction is not None:
        update = {"instruction": instruction}
        section = entry.configured(config, registry).model_copy(update=update)
        config = config.model_copy(update={kind: section})
    return entry.check(config, registry)


INSTRUCTION = StartForm(kind="inference", arguments=StartInference, plan=plan_instruction)
"""How clients ask for the configured policy where no feature lets them choose another."""


def start_tools(loop: ClosedLoop) -> list[Tool]:
    """Create a start tool for each kind of module, and set_instruction, in the order of
    their use.
    """
    return [*(_start_tool(loop, kind) for kind in loop.kinds), _set_instruction(loop)]


def _set_instruction(loop: ClosedLoop) -> Tool:
    async def set_instruction(arguments: SetInstruction, context: CallContext) -> InstructionResult:
        halt = threading.Event()
        report, took_s = await context.run(
            lambda _: give_instruction(loop, arguments.instruction, arguments.timeout_s, halt),
            on_cancel=halt.set,
        )
        return InstructionResult(
            instruction=report.instruction, took_s=round(took_s, 3), note=report.note
        )

    return Tool(
        name="set_instruction",
        title="Tell the robot what to do",
        description=(
            "Give the running policy an instruction. Returns at its first action, not at the end "
            "of the task; stop_inference ends the motion. If it cannot act on it, the error says "
            "why and nothing moves."
        ),
        arguments=SetInstruction,
        result=InstructionResult,
        handler=set_instruction,
        open_world=True,
        offered=loop.takes_policies,
    )


def _start_tool(loop: ClosedLoop, kind: ModuleKind) -> Tool:
    entry, form = loop.kinds[kind], loop.forms.get(kind)
    which = f" The configured one is the {loop.robot_facts}." if entry.kind == "robot" else ""

    async def handler(request: Arguments, context: CallContext) -> StartResult:
        started_s, halt = time.monotonic(), threading.Event()
        view = await context.run(
            lambda stage: loop.start(entry.kind, request, stage, context.role, halt),
            on_cancel=halt.set,
        )
        took_s = round(time.monotonic() - started_s, 3)
        unchecked = loop.unchecked if entry.kind in ("robot", "control") else ""
        more = {"unchecked": unchecked} if unchecked else {}
        return StartResult.short_of(view, took_s=took_s, **more)

    return Tool(
        name=f"start_{entry.kind}",
        title=entry.title,
        description=f"{entry.start_text}{which} Returns when {entry.proof}.",
        offered=loop.takes_policies if entry.kind == "inference" else lambda: True,
        arguments=NoArguments if form is None else form.arguments,
        choices={} if form is None else dict(form.choices),
        result=StartResult,
        handler=handler,
        open_world=True,
    )
