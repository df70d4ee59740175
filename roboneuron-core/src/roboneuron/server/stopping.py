"""The emergency stop and its reset, as tools."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

from pydantic import Field

from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.gate.request import ADMIN, VIEWER
from roboneuron.server.emergency import reset_command
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import EmergencyStopResult
from roboneuron.server.tool import Arguments, CallContext, NoArguments, Tool


class EmergencyStopArguments(Arguments):
    """Arguments of emergency_stop."""

    reason: str = Field(default="", max_length=500, description="Why; kept in the latch and in the audit.")


def emergency_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """emergency_stop and reset_emergency_stop."""
    stop = loop.emergency_stop

    def press(arguments: Mapping[str, Any], context: CallContext) -> None:
        """Latch before anything else: also when ROS is not joined yet, and when the arguments are wrong."""
        with suppress(UnsafeError):  # told by the call itself, which tries again
            stop.file.press(who=context.who, reason=str(arguments.get("reason") or ""))

    async def ask_person(context: CallContext) -> None:
        """Raises RefusedError unless a person agreed to release this very stop."""
        before, cause = stop.file.read_state(), stop.cause()
        since = (
            datetime.fromtimestamp(min(max(before.time_ns, 0), 2**62) / 1e9, UTC)
            .astimezone()
            .isoformat(" ", "milliseconds")
        )
        agreed = await context.ask(  # the time makes a question about another stop another question
            f"The emergency stop is latched since {since}{f' by {cause}' if cause else ''}. Release it? "
            "Look at the robot first: a policy that still has an instruction goes on with it."
        )
        if agreed and stop.file.read_state().time_ns == before.time_ns:
            return
        why = {None: "this client cannot ask one", False: "nobody agreed"}.get(agreed, "it was pressed again")
        raise RefusedError(
            f"Only a person releases the emergency stop, and {why}. It stays latched.",
            hint="Ask a person to look at the robot and to run, in a terminal on this machine: "
            f"{reset_command(stop.file.path.parent)}",
        )

    async def latch(arguments: EmergencyStopArguments, context: CallContext) -> EmergencyStopResult:
        confirmed, took_s = await context.run(
            lambda _: stop.latch(loop.config.namespace, who=context.who, reason=arguments.reason)
        )
        note = "" if confirmed else "No module runs; those that are started later are stopped from the beginning."
        return EmergencyStopResult(latched=True, confirmed_by=confirmed, took_s=round(took_s, 3), note=note)

    async def reset(_: NoArguments, context: CallContext) -> EmergencyStopResult:
        who = context.who
        if loop.base.server.reset_emergency_stop == "person" and stop.is_latched():
            await ask_person(context)
            who = f"a person asked by {who}"
        confirmed, took_s = await context.run(lambda _: stop.reset(loop.config.namespace, who=who, role=context.role))
        note = "Nothing moves by itself; a running backend acts again on the next image."
        return EmergencyStopResult(latched=False, confirmed_by=confirmed, took_s=round(took_s, 3), note=note)

    return [
        Tool(
            name="emergency_stop",
            title="Emergency stop",
            description=(
                "Stop all motion now and keep it stopped until reset_emergency_stop, across restarts of anything. "
                "Modules go on running. Returns when every running module has confirmed it; an error names those that "
                "have not."
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
                "Release the emergency stop. A person decides: the client asks one, if it can; otherwise the call is "
                "refused and says what a person has to do. A backend that still has an instruction goes on with it: "
                "stop_inference first if it should not."
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
