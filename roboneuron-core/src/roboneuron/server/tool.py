"""One tool as data: what the agent reads of it, and the function that does it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from pydantic import BaseModel, ConfigDict

T = TypeVar("T")
A = TypeVar("A", bound="Arguments")
Stage = Callable[[str], None]
"""Tells the caller how far a long call has come; callable from any thread."""


class Arguments(BaseModel):
    """Base of all argument models: nothing unknown, nothing converted."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class NoArguments(Arguments):
    """For tools without arguments."""


class Result(BaseModel):
    """Base of all result models."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """An image that goes to the agent as MCP image content; `data` is an encoded file."""

    data: bytes
    mime_type: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Reply:
    """A result, and pictures beside it."""

    result: Result
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """What a derived tool returns: JSON-able values that fit its output schema, and pictures beside them."""

    structured: Mapping[str, Any]
    pictures: tuple[Picture, ...] = ()


class CallContext(Protocol):
    """What a tool may do besides returning.

    Attributes:
        who: the client, for the audit.
        role: what it may do, see `roboneuron.gate.ROLES`.
    """

    @property
    def who(self) -> str: ...

    @property
    def role(self) -> str: ...

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """Run blocking `work` on a thread; its stages go to the client as progress.

        When the client cancels or leaves, `on_cancel` is called, the thread is left to end by itself, and the
        cancellation goes on. By some revisions of the protocol a client that loses its connection may come back for
        the answer and its call goes on; then only `on_leave` is called: what moves a robot ends with the connection.
        """
        ...

    async def ask(self, question: str) -> bool | None:
        """Whether the client's person agreed; None when it cannot ask one. May end the call and begin it again."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Tool(Generic[A]):
    """A tool.

    Attributes:
        name: snake_case, a verb first.
        title: for people.
        description: for the agent: what it does, when it returns, what comes before and after it.
        arguments, result: models; their JSON schemas are what the agent sees.
        handler: validated arguments -> Result or Reply; raises RoboNeuronError.
        read_only: changes nothing.
        destructive: may end or undo something.
        idempotent: a second call changes nothing more.
        open_world: reaches what this server does not control (the physical world counts).
        choices: argument name -> function that returns {choice: summary}, asked whenever tools are listed.
        role: least role of a caller; when empty, viewers may call what is read-only and operators everything else.
        always: it stops something, so it is done however many calls are at work already.
        urgent: done first of all, on the event loop, before the arguments are checked and anything is waited for;
            must not block or raise.
    """

    name: str
    title: str
    description: str
    arguments: type[A]
    result: type[Result]
    handler: Callable[[A, CallContext], Awaitable[Result | Reply]]
    read_only: bool = False
    destructive: bool = False
    idempotent: bool = False
    open_world: bool = False
    choices: dict[str, Callable[[], dict[str, str]]] = field(default_factory=dict)
    role: str = ""
    always: bool = False
    urgent: Callable[[Mapping[str, Any], CallContext], object] | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class DerivedTool:
    """A tool whose schemas were made at run time (from ROS interfaces); its handler checks the arguments itself.

    Attributes:
        input_schema, output_schema: JSON schemas of objects.
        handler: raw arguments -> Answer; raises RoboNeuronError.
        listed: in tools/list; others are found by search and called by name all the same.
        The rest is as in `Tool`.
    """

    name: str
    title: str
    description: str
    input_schema: dict[str, Any]
    output_schema: dict[str, Any]
    handler: Callable[[Mapping[str, Any], CallContext], Awaitable[Answer]]
    read_only: bool = False
    destructive: bool = False
    idempotent: bool = False
    open_world: bool = True
    listed: bool = True
    role: str = ""
    always: bool = False
