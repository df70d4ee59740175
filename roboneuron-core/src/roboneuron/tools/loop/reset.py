"""The tool that releases the emergency stop, after a person has agreed."""

from __future__ import annotations

from datetime import UTC, datetime

from pydantic import Field

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import Role
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool

_NOT_LATCHED = "The emergency stop is not latched; nothing was changed."


class ReleaseResult(Result):
    """State of the latch, as reported by the modules themselves."""

    latched: bool
    confirmed_by: list[str] = Field(description="running modules that report it")
    took_s: float
    note: str = ""


def reset_tool(loop: ClosedLoop) -> Tool[NoArguments]:
    """reset_emergency_stop."""
    stop = loop.emergency_stop

    async def ask_person(since_ns: int, context: CallContext, *, for_pin: bool) -> str:
        """Return the PIN typed by a person; raise RefusedError unless the person agreed to release
        this particular stop.
        """
        cause = stop.cause()
        since = (
            datetime.fromtimestamp(min(max(since_ns, 0), 2**62) / 1e9, UTC)
            .astimezone()
            .isoformat(" ", "milliseconds")
        )
        question = (  # the time distinguishes it from a question about another stop
            f"The emergency stop is latched since {since}{f' by {cause}' if cause else ''}. "
            "Release it? "
            "Look at the robot first. Nothing moves until someone gives a new instruction or "
            "moves the arm."
        )
        answer = await context.ask(question, "PIN" if for_pin else "")
        if answer and stop.file.read_state().time_ns == since_ns:
            return answer
        why = {None: "this client cannot ask one", "": "the person did not agree"}.get(
            answer, "it was pressed again"
        )
        raise RefusedError(
            f"Only a person releases the emergency stop, and {why}. It stays latched.",
            hint="Ask a person to look at the robot and to run, in a terminal on this machine: "
            f"{stop.file.release_command}",
            rule="person",
        )

    async def reset(_: NoArguments, context: CallContext) -> ReleaseResult:
        # first: nobody has agreed to release a stop that is pressed from here on
        since_ns = stop.file.read_state().time_ns
        if not stop.is_latched():
            return ReleaseResult(latched=False, confirmed_by=[], took_s=0.0, note=_NOT_LATCHED)
        who, pin = context.who, ""
        for_pin = stop.needs_pin
        if for_pin or loop.base.server.reset_emergency_stop == "person":
            pin = await ask_person(since_ns, context, for_pin=for_pin)
            who = f"a person asked by {who}"
        confirmed, took_s = await context.run(
            lambda _: stop.reset(
                loop.config.namespace, who=who, role=context.role, pin=pin, agreed_ns=since_ns
            )
        )
        return ReleaseResult(
            latched=False, confirmed_by=confirmed, took_s=round(took_s, 3), note=loop.starts.AGAIN
        )

    return Tool(
        name="reset_emergency_stop",
        title="Release the emergency stop",
        description=(
            "Release the emergency stop. A person must agree: the client asks, if it can; "
            "otherwise the refusal says what the person has to do. Nothing moves by itself: the "
            "policy needs a new instruction, by set_instruction or run_task."
        ),
        arguments=NoArguments,
        result=ReleaseResult,
        handler=reset,
        destructive=True,
        idempotent=True,
        open_world=True,
        role=Role.ADMIN,
    )
