"""The chain that every tool call passes: interceptors in the order of their phases."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from roboneuron.errors import InternalError, RoboNeuronError

if TYPE_CHECKING:
    from roboneuron.server.tool import Answer, CallContext, Tool


class CallPhase(IntEnum):
    """Phases of a call, in their order. docs/interceptors.md lists who acts in each.

    Those before READINESS belong to core, so that nothing of a feature can delay or prevent an
    emergency stop.

    Attributes:
        SIMULATION: a call that only asks what would happen becomes a call that only reads.
        RECORD: the call is reported when it begins and when it has ended, whatever its outcome.
        IDENTITY: the tool exists, and the client's role may call it.
        STOP: an emergency stop takes effect, before anything that may wait or refuse.
        READINESS: waits until the server has joined the ROS graph.
        LOAD: bounds the number of concurrent calls.
        PERMISSION: whether anybody may act now.
        ARBITRATION: whether this client may act now.
        ARGUMENTS: the arguments are checked; `IncomingCall.parsed` is set from here on.
        CONFIRMATION: a person is asked.
        HANDLER: around the tool's handler, for calls that nothing has refused.
    """

    SIMULATION = 1
    RECORD = 2
    IDENTITY = 3
    STOP = 4
    READINESS = 5
    LOAD = 6
    PERMISSION = 7
    ARBITRATION = 8
    ARGUMENTS = 9
    CONFIRMATION = 10
    HANDLER = 11


@dataclass(frozen=True, kw_only=True, slots=True)
class IncomingCall:
    """A tool call on its way through the chain; an interceptor hands on a changed copy.

    Attributes:
        name: of the tool, as sent.
        arguments: as sent.
        context: services for the call; its client.
        found: the tool of that name; None if there is none, which IDENTITY refuses.
        parsed: the checked arguments, an instance of the tool's model; None before ARGUMENTS.
        refused: why IDENTITY refuses it, found earlier; None for most calls.
        deprecated: sentence for the answer about an argument that has another name now.
    """

    name: str
    arguments: Mapping[str, Any]
    context: CallContext
    found: Tool[Any] | None
    parsed: Any = None
    refused: RoboNeuronError | None = None
    deprecated: str = ""

    @property
    def tool(self) -> Tool[Any]:
        """The tool. Raises InternalError if there is none, which only phases before IDENTITY
        meet.
        """
        if self.found is None:
            raise InternalError(f"There is no tool {self.name[:80]!r}.")
        return self.found


Proceed: TypeAlias = "Callable[[IncomingCall], Awaitable[Answer]]"
"""Passes a call to the rest of the chain; returns the answer, or raises RoboNeuronError."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Simulator:
    """The twin that carries out simulated calls; declared by `Feature.simulator`.

    Attributes:
        tool: name of a read-only tool that is called instead, with the arguments `tool` and
            `arguments` of the call.
        is_there: returns True if there is a twin of the present robot.
    """

    tool: str
    is_there: Callable[[], bool]


@dataclass(frozen=True, kw_only=True, slots=True)
class EndedCall:
    """A call that has ended, for the listeners of `Events.call_ended`.

    Attributes:
        call: as the client sent it.
        outcome: "answered", also with an error; "asked" if it ended with a question to the client's
            user, after which the client repeats it; "cancelled" if the client gave it up.
        answer: the answer; None without one.
        error: the error of a call that failed.
        took_s: duration [s].
    """

    call: IncomingCall
    outcome: Literal["answered", "asked", "cancelled"]
    answer: Answer | None = None
    error: RoboNeuronError | None = None
    took_s: float

    @property
    def code(self) -> str:
        """The code of the error; empty without one."""
        return "" if self.error is None else self.error.code


@dataclass(frozen=True, kw_only=True, slots=True)
class Interceptor:
    """A step that calls pass; declared by `Feature.interceptors`. It has one of `check`, `change`
    and `around`.

    All run on the event loop. An exception other than RoboNeuronError fails the call, so that a
    broken check refuses.

    Attributes:
        name: for the list of the chain; unique.
        phase: its place, READINESS or later; within a phase, core comes first, then features in the
            order of loading.
        check: raises RoboNeuronError for a call that may not pass now; must not block. From
            PERMISSION and ARBITRATION it is asked again while a call goes on, see
            `CallChain.check_permitted`.
        change: returns the call that the rest of the chain gets, or raises; must not block.
        around: receives the call and the rest of the chain, and returns the answer.
        tools: names of the tools that it applies to; None for all.
        told: sentence added to the descriptions of these tools.
    """

    name: str
    phase: CallPhase
    check: Callable[[Tool[Any], CallContext], None] | None = None
    change: Callable[[IncomingCall], IncomingCall] | None = None
    around: Callable[[IncomingCall, Proceed], Awaitable[Answer]] | None = None
    tools: frozenset[str] | None = None
    told: str = ""
