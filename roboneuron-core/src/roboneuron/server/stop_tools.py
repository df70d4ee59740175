"""Tools that stop: one module, all modules, and the emergency stop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from pydantic import Field

from roboneuron.errors import StateError
from roboneuron.gate.roles import Role
from roboneuron.modules.settings import MODULE_KINDS
from roboneuron.planning import KindEntry
from roboneuron.server.call_chain import EMERGENCY_TOOL
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Result, Tool
from roboneuron.supervisor.health import Stopped


class StopResult(Stopped, Result):
    """Result of a stop: the process is gone from the process table, or its start was cancelled."""

    still_moving: list[str] = Field(
        default_factory=list, description="what moves the robot all the same; stop_motion ends it"
    )


FIRST_STATE = (
    "The robot is simulated: each start of it sets the arm and the table as they were at first. "
    "Tightened limits stay."
)


class StopAllResult(Result):
    """Everything that was stopped, in that order; empty if nothing ran."""

    stopped: list[StopResult]
    note: str = Field(default="", description="what the next start changes")


class EmergencyStopResult(Result):
    """State of the latch, as reported by the modules themselves."""

    latched: bool
    confirmed_by: list[str] = Field(description="running modules that report it")
    took_s: float
    note: str = ""


def stop_tools(
    loop: ClosedLoop, motions: Callable[[], Sequence[str]] = lambda: ()
) -> list[Tool[Any]]:
    """A tool for each kind of module, and stop_all.

    Args:
        loop: the closed loop.
        motions: see `Host.motions`.
    """
    # those without which nothing works last
    order = (*MODULE_KINDS, *(kind for kind in loop.kinds if kind not in MODULE_KINDS))
    tools = [_stop_tool(loop, loop.kinds[kind], motions) for kind in order]
    return [*tools, _stop_all(loop)]


def _stop_tool(
    loop: ClosedLoop, entry: KindEntry, motions: Callable[[], Sequence[str]]
) -> Tool[Any]:
    kind = entry.kind

    async def handler(_: NoArguments, context: CallContext) -> StopResult:
        try:
            stopped = await context.run(lambda _: loop.stop(kind))
        except StateError as error:
            moving = motions()
            if not moving:
                raise
            raise StateError(
                f"{error.message} The robot is still moved by: {', '.join(moving)}.",
                hint="Call stop_motion: it ends whatever moves.",
            ) from error
        return StopResult(**dict(stopped), still_moving=list(motions()))

    return Tool(
        name=f"stop_{kind}",
        title=f"Stop {kind}",
        description=entry.stop_text,
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
        is_simulated = loop.robot_facts.kind == "simulated"
        stopped = await context.run(lambda _: loop.stop_all())
        return StopAllResult(
            stopped=[StopResult(**dict(one)) for one in stopped],
            note=FIRST_STATE if is_simulated and stopped else "",
        )

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


class EmergencyStopArguments(Arguments):
    """Arguments of emergency_stop."""

    reason: str = Field(
        default="", max_length=500, description="Why; kept in the latch and in the audit."
    )


def emergency_tool(loop: ClosedLoop) -> Tool[Any]:
    """emergency_stop."""
    stop = loop.emergency_stop

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

    return Tool(
        name=EMERGENCY_TOOL,
        title="Emergency stop",
        description=(
            "For danger: stop all motion at once. Nothing moves until a person releases it, "
            "even after restarts. Returns when every running module has confirmed it; an error "
            "names those that have not."
        ),
        arguments=EmergencyStopArguments,
        result=EmergencyStopResult,
        handler=latch,
        destructive=True,
        idempotent=True,
        open_world=True,
        role=Role.VIEWER,  # every role that sees the robot may stop it
        always=True,
    )
