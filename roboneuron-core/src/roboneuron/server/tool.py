"""Tools and resources as data: what the agent reads of one, the function behind it, and who calls
it.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeAlias

from pydantic import BaseModel, ConfigDict
from pydantic.json_schema import JsonSchemaValue
from pydantic.version import version_short
from typing_extensions import TypeVar

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import Role
from roboneuron.server.schema import Shape, model_schema, parse, with_choices
from roboneuron.supervisor.changes import Stage

if TYPE_CHECKING:
    from anyio import Event

T = TypeVar("T")
A = TypeVar("A", bound="Arguments", default=Any)


class Arguments(BaseModel):
    """Base of all argument models: nothing unknown, nothing converted, no NaN and no infinity."""

    # built when first used: a start makes many of them, and most are never called
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True
    )

    def given(self) -> dict[str, Any]:
        """What the caller gave, without defaults; for the audit."""
        return self.model_dump(exclude_unset=True)


class NoArguments(Arguments):
    """For tools without arguments."""


class Result(BaseModel):
    """Base of all result models.

    Attributes:
        sparse: of an answer that leaves out what its handler did not set; other answers have all
            fields.
    """

    # built when first used, which may be by several threads at once: pydantic 2.14 bears that first
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=version_short() >= "2.14")

    sparse: ClassVar[bool] = False


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
    """What a client gets: JSON-able values that fit the tool's output schema, and pictures beside
    them.
    """

    structured: Mapping[str, Any]
    pictures: tuple[Picture, ...] = ()


_LOCAL_CLIENT = "local HTTP client"
Transport: TypeAlias = "Callable[[Event], Awaitable[None]]"
"""Serves clients on the event loop until the event is set."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of `Role`; anything else has no rights.
        client: which of several clients without a token; empty for others.
        watched: calls a listener when the connection of this request is lost within the block, or
            was before; None where that cancels the call, as on stdio.
        KEY: where a transport of a feature leaves the Holder in the scope of a request.
    """

    KEY: ClassVar = "roboneuron.holder"

    who: str
    role: str
    client: str = ""
    watched: Callable[[Callable[[], object]], AbstractContextManager[None]] | None = None

    @classmethod
    def local(cls, client: str = "") -> Holder:
        """A client of a server on loopback that asks for no token: anybody on this machine, who
        could start one as well. `client` tells it apart from others: "session 1a2b", "pid 123".
        """
        return cls(who=f"{_LOCAL_CLIENT} {client}".rstrip(), role=Role.ADMIN, client=client)

    @staticmethod
    def is_local(who: str) -> bool:
        """Whether that client was let in without a token; no token can have such a name."""
        return who == LOCAL_AGENT.who or who.startswith(_LOCAL_CLIENT)


LOCAL_AGENT = Holder(who="agent on stdio", role=Role.ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Who sent a request; None is stdio. A request without a Holder has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(Holder.KEY)
    return holder if isinstance(holder, Holder) else NOBODY


class CallContext(Protocol):
    """What a tool may do besides returning."""

    @property
    def who(self) -> str:
        """The client, for the audit."""

    @property
    def role(self) -> str:
        """What it may do, see `roboneuron.gate.Role`."""

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """Run blocking `work` on a thread; its stages go to the client as progress.

        When the client cancels or leaves, `on_cancel` is called, the thread is left to end by
        itself, and the cancellation goes on. By some revisions of the protocol a client that loses
        its connection may come back for the answer and its call goes on; then only `on_leave` is
        called: what moves a robot ends with the connection.
        """

    async def ask(self, question: str, what: str = "") -> str | None:
        """What the client's person answers: "yes", or what they type when asked for `what`, such as
        a PIN; empty when they do not agree, None when it cannot ask one. May end the call and begin
        it again.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class Tool(Generic[A]):
    """A tool.

    Attributes:
        name: snake_case, a verb first.
        title: for people.
        description: for the agent: what it does, when it returns, what comes before and after it.
        arguments, result: models, whose JSON schemas are what the agent sees; or a `Shape` of one.
        handler: validated arguments -> Result or Reply; raises RoboNeuronError.
        read_only: changes nothing.
        destructive: may end or undo something.
        idempotent: a second call changes nothing more.
        open_world: reaches what this server does not control (the physical world counts).
        listed: in tools/list; others are found by search and called by name all the same.
        offered: whether it makes sense for the present robot, asked whenever tools are listed;
            called by name all the same.
        seldom: needed for few requests; a server of several robots may leave it out of its list, to
            be found by search.
        choices: argument name -> function that returns {choice: summary}, asked whenever tools are
            listed.
        role: least role of a caller; when empty, viewers may call what is read-only and operators
            everything else.
        always: it stops something, so it is done however many calls are at work already.
        urgent: done first of all, on the event loop, before the arguments are checked and anything
            is waited for; must not block or raise.
    """

    name: str
    title: str
    description: str
    arguments: type[A] | Shape[A]
    result: type[Result] | Shape[Result]
    handler: Callable[[A, CallContext], Awaitable[Result | Reply]]
    read_only: bool = False
    destructive: bool = False
    idempotent: bool = False
    open_world: bool = False
    listed: bool = True
    offered: Callable[[], bool] = lambda: True
    seldom: bool = False
    choices: dict[str, Callable[[], dict[str, str]]] = field(default_factory=dict)
    role: str = ""
    always: bool = False
    urgent: Callable[[Mapping[str, Any], CallContext], object] | None = None

    @property
    def least_role(self) -> Role:
        """The least role that may call it."""
        if self.role:
            return Role(self.role)
        return Role.VIEWER if self.read_only else Role.OPERATOR

    def check_caller(self, context: CallContext) -> None:
        """Do nothing when the caller may call it. Raises RefusedError, which names the roles."""
        if not self.least_role.is_held_by(context.role):
            raise RefusedError(
                f"{self.name} needs the role '{self.least_role}'; {context.who} has "
                f"{context.role or 'none'!r}.",
                hint="Use a token with that role, or ask a person who has one.",
                rule="role",
            )

    def input_schema(self) -> JsonSchemaValue:
        """The JSON schema of the arguments, with today's choices."""
        schema = model_schema(self.arguments)
        return with_choices(schema, self._choices()) if self.choices else schema

    def output_schema(self) -> JsonSchemaValue:
        """The JSON schema of the result."""
        return model_schema(self.result, result=True)

    def parsed(self, arguments: Mapping[str, Any]) -> A:
        """The arguments of a call as the model. Raises InvalidInputError: they do not fit."""
        return parse(self.arguments, arguments, self._choices())

    async def call(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Check the arguments and do it. Raises as `parsed`, and what the handler raises."""
        outcome = await self.handler(self.parsed(arguments), context)
        reply = outcome if isinstance(outcome, Reply) else Reply(result=outcome)
        return Answer(
            structured=reply.result.model_dump(
                mode="json", exclude_unset=isinstance(self.result, Shape) or self.result.sparse
            ),
            pictures=reply.pictures,
        )

    def _choices(self) -> dict[str, dict[str, str]]:
        return {name: ask() for name, ask in self.choices.items()}


@dataclass(frozen=True, kw_only=True, slots=True)
class Resource:
    """An MCP resource.

    Attributes:
        uri: such as "roboneuron://logs/robot".
        name, title, description: what clients see.
        read: returns the text; called on the event loop, so it must be quick.
        mime_type: of that text.
    """

    uri: str
    name: str
    title: str
    description: str
    read: Callable[[], str]
    mime_type: str = "text/plain"
