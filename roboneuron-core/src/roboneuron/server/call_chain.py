"""The chain that every tool call passes: the steps of core, and those that features declare."""

from __future__ import annotations

import json
import logging
import time
import uuid
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, Literal, Protocol, TypeVar

from mcp import types

from roboneuron.errors import (
    InternalError,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    RoboNeuronError,
    UnsafeError,
    nearest,
    shortened,
)
from roboneuron.server.interception import (
    CallPhase,
    EndedCall,
    IncomingCall,
    Interceptor,
    Proceed,
    Simulator,
)
from roboneuron.server.schema import Shape
from roboneuron.server.tool import Answer, CallContext, Tool
from roboneuron.supervisor.changes import Stage

log = logging.getLogger(__name__)
T = TypeVar("T")
EMERGENCY_TOOL = "emergency_stop"
SIMULATE = "simulate"
"""Argument of a call that is simulated instead of carried out."""
_OLD_NAMES = ("dry_run", "preview")
"""Former names of it, accepted in 0.1."""
_NAMES = frozenset({SIMULATE, *_OLD_NAMES})
MOST_TEXT = 2000
"""Maximum length of an error's text [characters]."""
_MOST_ANSWER = 100_000
"""Maximum length of a read-only tool's answer [characters], for tools without their own bound."""
_LISTED = "tools/list (`roboneuron tools`) names those that this robot has."


class UnfinishedCallError(Exception):
    """Ends a call with a question to the client's user, whose answer comes with the next call; not
    a failure.
    """

    def __init__(self, result: types.InputRequiredResult) -> None:
        super().__init__("a person is asked")
        self.result = result


class Press(Protocol):
    """Latches the emergency stop at once, on the event loop. Raises UnsafeError."""

    def __call__(self, *, who: str, reason: str) -> object: ...


class CallChain:
    """Interceptors in the order of their phases, in front of a tool's handler.

    Args:
        find: returns the tool of a name.
        names: returns the names of all tools.
        most_calls: maximum number of concurrent calls by clients of one role, so that viewers
            cannot block operators; a stop is never refused.
        on_begin, on_end: see `Events.call_begun` and `Events.call_ended`.
        acts_on: the robot in words; part of every answer of a tool that acts on it.

    Attributes:
        steps: all interceptors, in the order in which calls pass them.
        ready: awaited in the phase READINESS; None when there is nothing to wait for.
        running: calls that work now, in the order of their begin; changed on the event loop only.
    """

    def __init__(
        self,
        find: Callable[[str], Tool[Any] | None],
        names: Callable[[], Iterable[str]],
        *,
        most_calls: int,
        on_begin: Callable[[IncomingCall], object],
        on_end: Callable[[EndedCall], object],
        acts_on: Callable[[], str] | None,
    ) -> None:
        self._find, self._names = find, names
        self._most_calls = most_calls
        self._calls: Counter[str] = Counter()
        self.running: dict[int, IncomingCall] = {}
        self._on_begin, self._on_end = on_begin, on_end
        self._acts_on = acts_on
        self._simulator: Simulator | None = None
        self.ready: Callable[[], Awaitable[None]] | None = None
        self.steps: tuple[Interceptor, ...] = ()
        self._add(
            Interceptor(name="simulate", phase=CallPhase.SIMULATION, change=self._simulate),
            Interceptor(name="record", phase=CallPhase.RECORD, around=self._record),
            Interceptor(name="role", phase=CallPhase.IDENTITY, change=self._identify),
            Interceptor(name="ros", phase=CallPhase.READINESS, around=self._await_ready),
            Interceptor(name="slots", phase=CallPhase.LOAD, around=self._count),
            Interceptor(name="arguments", phase=CallPhase.ARGUMENTS, change=self._parse),
        )

    def intercept(self, steps: Iterable[Interceptor]) -> None:
        """Add a feature's interceptors, each behind those of its phase, while the server is
        assembled.

        Raises:
            InternalError: one has not exactly one of `check`, `change` and `around`, a name that
                exists, or a phase before READINESS.
        """
        added = list(steps)
        for step in added:
            if step.phase < CallPhase.READINESS:
                raise InternalError(
                    f"Interceptor {step.name!r} is in the phase {step.phase.name}, which belongs "
                    "to core; choose READINESS or a later one."
                )
        self._add(*added)

    def press_first(self, press: Press) -> None:
        """Let `press` latch the emergency stop in the phase STOP: before ROS is joined, and also
        with invalid arguments.
        """

        def stop(call: IncomingCall) -> IncomingCall:
            with suppress(UnsafeError):  # reported by the call itself, which tries again
                press(who=call.context.who, reason=str(call.arguments.get("reason") or ""))
            return call

        of_tool = frozenset({EMERGENCY_TOOL})
        self._add(
            Interceptor(name=EMERGENCY_TOOL, phase=CallPhase.STOP, change=stop, tools=of_tool)
        )

    def simulate_with(self, simulator: Simulator) -> None:
        """Set what simulates calls, while the server is assembled. Raises InternalError: something
        does so already.
        """
        if self._simulator is not None:
            raise InternalError(f"{self._simulator.tool!r} simulates calls already.")
        self._simulator = simulator

    def check_permitted(self, tool: Tool[Any], context: CallContext) -> None:
        """Check again whether that client may call the tool now, for work that lasts longer than a
        call. Raises RoboNeuronError as the checks of PERMISSION and ARBITRATION.
        """
        for step in self.steps:
            is_for_it = step.tools is None or tool.name in step.tools
            is_asked = step.phase in (CallPhase.PERMISSION, CallPhase.ARBITRATION)
            if step.check is not None and is_for_it and is_asked:
                step.check(tool, context)

    def told(self, tool: str) -> str:
        """What the interceptors of a tool add to its description, with a space before each."""
        texts = (step.told for step in self.steps if step.tools is not None and tool in step.tools)
        return "".join(f" {text}" for text in texts if text)

    async def run(self, call: IncomingCall, first: int = 0) -> Answer:
        """Pass a call through the chain from step `first` on, and to its handler.

        Raises:
            RoboNeuronError: it was refused or failed.
            UnfinishedCallError: the client's user is asked.
        """
        for after, tools, check, change, around in self._rest[first]:
            if tools is not None and call.name not in tools:
                continue
            if change is not None:
                call = change(call)
            elif around is not None:
                return await around(call, partial(self.run, first=after))
            # from IDENTITY on there is a tool; no check comes before
            elif check is not None and call.found is not None:
                check(call.found, call.context)
        return await self._handle(call)

    def _add(self, *steps: Interceptor) -> None:
        ordered = sorted([*self.steps, *steps], key=lambda step: step.phase)
        names = [step.name for step in ordered]
        for step in ordered:
            if [step.check, step.change, step.around].count(None) != 2:
                raise InternalError(
                    f"Interceptor {step.name!r} needs one of check, change and around."
                )
            if names.count(step.name) > 1:
                raise InternalError(f"There are two interceptors called {step.name!r}.")
        self.steps = tuple(ordered)
        # every call passes these: tuples are read faster than attributes
        parts = [
            (after, step.tools, step.check, step.change, step.around)
            for after, step in enumerate(ordered, 1)
        ]
        self._rest = [parts[first:] for first in range(len(parts) + 1)]

    def _simulate(self, call: IncomingCall) -> IncomingCall:
        """Hand on a call with simulate=true as one that only reads, so that neither role, operator
        nor lease are asked for it: of the twin's tool, or of its own tool with a context by which
        the gate sends nothing. Any other tool refuses it.
        """
        tool, given = call.found, call.arguments
        # first what nearly every call passes; and a stop is never only simulated
        if given.keys().isdisjoint(_NAMES) or tool is None or tool.name == EMERGENCY_TOOL:
            return call
        asked = {name: given[name] for name in _names(tool) if name in given}
        if not asked:
            return call
        own = {key: value for key, value in given.items() if key not in asked}
        call = replace(call, arguments=own, deprecated=_deprecated(asked))
        for name, value in asked.items():
            if not isinstance(value, bool):
                error = InvalidInputError(f"{name!r} has to be true or false.", path=name)
                return replace(call, refused=error)
        if not any(asked.values()):
            return call
        call = replace(call, context=SimulatedContext(call.context))
        twin = self._simulator
        if twin is not None and "twin" in tool.simulated_by and twin.is_there():
            return replace(
                call,
                name=twin.tool,
                found=self._find(twin.tool),
                arguments={"tool": call.name, "arguments": own},
            )
        try:
            tool.check_simulation(call.context)
        except RefusedError as error:
            return replace(call, refused=error)
        return replace(call, found=tool.simulation())

    async def _record(self, call: IncomingCall, proceed: Proceed) -> Answer:
        """Report the call; give every failure a code, and the log its traceback."""
        self._on_begin(call)
        begun_s = time.monotonic()
        error: RoboNeuronError | None = None
        answer: Answer | None = None
        outcome: Literal["answered", "asked", "cancelled"] = "cancelled"
        try:
            answer = await proceed(call)
            outcome = "answered"
            return answer
        except RoboNeuronError as refused:
            text = clipped(str(refused))
            log.info("%s was refused: %s: %s", shortened(call.name), refused.code, text)
            outcome, error = "answered", refused
            raise
        except UnfinishedCallError:
            outcome = "asked"
            raise
        except Exception as failed:  # the border of a call: the log gets the traceback
            outcome, error = "answered", incident(call.name)
            raise error from failed
        finally:
            took_s = time.monotonic() - begun_s
            self._on_end(
                EndedCall(call=call, outcome=outcome, answer=answer, error=error, took_s=took_s)
            )

    def _identify(self, call: IncomingCall) -> IncomingCall:
        if call.found is None:
            raise InvalidInputError(
                f"There is no tool {shortened(call.name)}.",
                hint=nearest(call.name, self._names(), _LISTED),
                path="tool",
            )
        if call.refused is not None:
            raise call.refused
        call.found.check_caller(call.context)
        return call

    async def _await_ready(self, call: IncomingCall, proceed: Proceed) -> Answer:
        if self.ready is not None:
            await self.ready()
        return await proceed(call)

    async def _count(self, call: IncomingCall, proceed: Proceed) -> Answer:
        role = call.context.role
        self._calls[role] += 1
        self.running[id(call)] = call
        try:
            if self._calls[role] > self._most_calls and not call.tool.always:
                raise NotReadyError(
                    f"{self._most_calls} calls are already running for the role {role!r}; "
                    "no more are accepted.",
                    hint="Wait for one to end; max_concurrent_calls in [server] sets how many "
                    "there may be.",
                )
            return await proceed(call)
        finally:
            self._calls[role] -= 1
            del self.running[id(call)]

    def _parse(self, call: IncomingCall) -> IncomingCall:
        assert call.found is not None
        return replace(call, parsed=call.found.parsed(call.arguments))

    async def _handle(self, call: IncomingCall) -> Answer:
        """Call the handler and complete its answer. Raises InvalidInputError: it is too long."""
        tool = call.found
        assert tool is not None
        answer = await tool.answer(call.parsed, call.context)
        structured = dict(answer.structured)
        if tool.open_world and not tool.read_only and self._acts_on is not None:
            structured["acts_on"] = self._acts_on()
        if call.deprecated:
            structured["deprecated"] = call.deprecated
        text = json.dumps(structured)
        if tool.read_only and len(text) > _MOST_ANSWER:
            raise InvalidInputError(
                f"The answer of {tool.name} has {len(text)} characters: too many.",
                hint="Ask for less: its arguments narrow what it answers.",
            )
        return Answer(structured=structured, pictures=answer.pictures, text=text)


class SimulatedContext:
    """CallContext of a call that only asks what would happen."""

    simulated = True

    def __init__(self, context: CallContext) -> None:
        self._context = context
        self.who, self.role = context.who, context.role

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """See `CallContext.run`."""
        return await self._context.run(work, on_cancel=on_cancel, on_leave=on_leave)

    async def ask(self, question: str, what: str = "") -> str | None:
        """See `CallContext.ask`: nobody is asked, since nothing is done."""
        return None


def _names(tool: Tool[Any]) -> tuple[str, ...]:
    """Names by which a call of the tool may ask for a simulation: not those of its own
    arguments.
    """
    kind = tool.arguments
    fields = (kind.model if isinstance(kind, Shape) else kind).model_fields
    return (SIMULATE, *(name for name in _OLD_NAMES if name not in fields))


def _deprecated(asked: Iterable[str]) -> str:
    old = [name for name in asked if name != SIMULATE]
    return f"{' and '.join(old)} is called {SIMULATE} now; 0.2 will refuse it." if old else ""


def incident(name: str) -> InternalError:
    """Log the present exception, and return an error that names the record in the log."""
    number = uuid.uuid4().hex[:8]
    log.exception("%s failed (incident %s)", name, number)
    return InternalError(
        f"{name} failed unexpectedly (incident {number}).",
        hint="The server's log has the details; get_status tells what is running.",
    )


def clipped(text: str) -> str:
    """Bound the length of an error's text, which may quote the caller's arguments."""
    return text if len(text) <= MOST_TEXT else f"{text[: MOST_TEXT - 100]} ... {text[-80:]}"
