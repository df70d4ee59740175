"""Tools and resources as data: the description for the agent, the handler, and the caller's
context.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Protocol, TypeAlias

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
_SIMULATE: JsonSchemaValue = {
    "simulate": {
        "type": "boolean",
        "default": False,
        "description": "Only say what would happen.",
    }
}


class Arguments(BaseModel):
    """Base of all argument models: no unknown fields, no conversions, no NaN or infinity."""

    # built on first use: a start creates many models, most of which are never called
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True
    )

    def given(self) -> dict[str, Any]:
        """Arguments given by the caller, without defaults; for the audit."""
        return self.model_dump(exclude_unset=True)


class NoArguments(Arguments):
    """For tools without arguments."""


class Result(BaseModel):
    """Base of all result models.

    Attributes:
        sparse: the answer leaves out fields that its handler did not set; other answers have all
            fields.
    """

    # built on first use, possibly by several threads at once, which pydantic 2.14 is the first to
    # support
    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=version_short() >= "2.14")

    sparse: ClassVar[bool] = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Picture:
    """An image for the agent as MCP image content; `data` is an encoded file."""

    data: bytes
    mime_type: str


@dataclass(frozen=True, kw_only=True, slots=True)
class Reply:
    """A result with pictures."""

    result: Result
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """The answer to a client.

    Attributes:
        structured: JSON-serialisable values that fit the tool's output schema.
        pictures: for the agent.
        text: `structured` as JSON; empty until the chain has completed the answer.
    """

    structured: Mapping[str, Any]
    pictures: tuple[Picture, ...] = ()
    text: str = ""


_LOCAL_CLIENT = "local HTTP client"
Transport: TypeAlias = "Callable[[Event], Awaitable[None]]"
"""Serves clients on the event loop until the event is set."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as identified by the transport.

    Attributes:
        who: name for the audit and the log.
        role: one of `Role`; anything else has no rights.
        client: distinguishes several clients without a token; empty for others.
        watched: registers a listener that is called when the connection of this request is lost
            within the block, or was lost before; None where a loss cancels the call, as on stdio.
        KEY: key of the Holder in the scope of a request, set by a feature's transport.
    """

    KEY: ClassVar = "roboneuron.holder"

    who: str
    role: str
    client: str = ""
    watched: Callable[[Callable[[], object]], AbstractContextManager[None]] | None = None

    @classmethod
    def local(cls, client: str = "") -> Holder:
        """Create the holder for a client of a loopback server without tokens: any local user, who
        could also start a server. `client` distinguishes it: "session 1a2b", "pid 123".
        """
        return cls(who=f"{_LOCAL_CLIENT} {client}".rstrip(), role=Role.ADMIN, client=client)

    @staticmethod
    def is_local(who: str) -> bool:
        """True if that client was admitted without a token; no token can have such a name."""
        return who == LOCAL_AGENT.who or who.startswith(_LOCAL_CLIENT)


LOCAL_AGENT = Holder(who="agent on stdio", role=Role.ADMIN)
"""The client of a stdio server: it started the server, so it has every role."""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Return the sender of a request; None is stdio. A request without a Holder has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(Holder.KEY)
    return holder if isinstance(holder, Holder) else NOBODY


class CallContext(Protocol):
    """Services for a tool during a call."""

    @property
    def simulated(self) -> bool:
        """The call only asks what would happen; the gate sends nothing of it."""

    @property
    def who(self) -> str:
        """Name of the client, for the audit."""

    @property
    def role(self) -> str:
        """Role of the client, see `roboneuron.gate.Role`."""

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """Run blocking `work` on a thread; its stages are sent to the client as progress.

        When the client cancels or disconnects, `on_cancel` is called, the thread ends by itself,
        and the cancellation is propagated. In some revisions of the protocol a client that loses
        its connection may return for the answer, and its call continues; then only `on_leave` is
        called, and what moves a robot ends with the connection.
        """

    async def ask(self, question: str, what: str = "") -> str | None:
        """Ask the client's user; return "yes", or the typed text if asked for `what`, such as a
        PIN; empty if the user does not agree, None if the client cannot ask. May end the call and
        restart it.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class Tool(Generic[A]):
    """A tool.

    Attributes:
        name: snake_case, starts with a verb.
        title: for users.
        description: for the agent: its effect, when it returns, the steps before and after it.
        arguments, result: models whose JSON schemas the agent sees; or a `Shape` of one.
        handler: validated arguments -> Result or Reply; raises RoboNeuronError.
        read_only: changes nothing.
        destructive: it may end or undo something.
        idempotent: a second call changes nothing more.
        open_world: affects what this server does not control (including the physical world).
        listed: may be in tools/list; other tools can be called by name. Of these, find_tools finds
            only derived ones.
        offered: returns True if it applies to the present robot, evaluated for each listing; it can
            be called by name in any case.
        seldom: rarely needed; left out of tools/list, and found by find_tools.
        choices: argument name -> function that returns {choice: summary}, called for each listing.
        role: required role; if empty, viewers may call read-only tools and operators all others.
        always: it stops something, and is exempt from the limit of concurrent calls.
        simulated_by: what answers a call with simulate=true: "twin" is the server's `Simulator`,
            "limits" the handler itself, whose requests to the gate are then judged and not sent.
            With both, the twin does so if there is one. Empty: such a call is refused.
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
    simulated_by: frozenset[Literal["twin", "limits"]] = frozenset()

    @property
    def least_role(self) -> Role:
        """The role that a caller needs."""
        return Role(self.role or (Role.VIEWER if self.read_only else Role.OPERATOR))

    def check_caller(self, context: CallContext) -> None:
        """Raise RefusedError, which names the roles, unless the caller may call it."""
        self.least_role.check(context.who, context.role, self.name)

    def input_schema(self) -> JsonSchemaValue:
        """The JSON schema of the arguments, with current choices."""
        schema = model_schema(self.arguments)
        if self.simulated_by:
            schema = {**schema, "properties": {**schema.get("properties", {}), **_SIMULATE}}
        return with_choices(schema, self._choices()) if self.choices else schema

    def output_schema(self) -> JsonSchemaValue:
        """The JSON schema of the result."""
        return model_schema(self.result, result=True)

    def parsed(self, arguments: Mapping[str, Any]) -> A:
        """Parse the arguments of a call. Raises InvalidInputError: they do not fit."""
        return parse(self.arguments, arguments, self._choices() if self.choices else {})

    async def call(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Check the arguments and call the handler, as a part of another call. Raises as `parsed`,
        and the handler's errors.
        """
        return await self.answer(self.parsed(arguments), context)

    def simulation(self) -> Tool[A]:
        """The tool as one that only reads, for calls that its handler answers by the limits."""
        return replace(self, read_only=True, destructive=False)

    def check_simulation(self, context: CallContext) -> None:
        """Raise RefusedError for a simulated call, unless the handler may answer it: it could
        otherwise move something.
        """
        if not context.simulated or "limits" in self.simulated_by:
            return
        if self.read_only:
            hint = "It changes nothing: call it without simulate."
        elif "twin" in self.simulated_by:
            hint = "That takes a simulated driver of the robot, and the feature 'simulate'."
        else:
            hint = "roboneuron tools lists `simulate` for those that can be."
        raise RefusedError(
            f"{self.name} cannot be simulated here; nothing was done.", hint=hint, rule="simulate"
        )

    async def answer(self, parsed: A, context: CallContext) -> Answer:
        """Call the handler with checked arguments. Raises its errors."""
        if not self.read_only and context.simulated:  # called by another tool in a simulated call
            self.check_simulation(context)
        outcome = await self.handler(parsed, context)
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
        name, title, description: shown to clients.
        read: returns the text; called on the event loop, so it must be quick.
        mime_type: of that text.
    """

    uri: str
    name: str
    title: str
    description: str
    read: Callable[[], str]
    mime_type: str = "text/plain"
