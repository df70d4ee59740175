"""Tools expose_endpoint and unexpose_endpoint: an admin changes the exposed endpoints at
run time.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

from pydantic import Field

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import Role
from roboneuron.server.tool import Arguments, CallContext, Holder, Result, Tool
from roboneuron.tools.ros.options import ExposeConfig


class ExposeEndpoint(ExposeConfig, Arguments):
    """Arguments of expose_endpoint: an `[[expose]]` entry."""


class UnexposeEndpoint(Arguments):
    """Arguments of unexpose_endpoint."""

    name: str = Field(max_length=64, description="the endpoint, as list_topics calls it")
    robot: str | None = Field(
        default=None, max_length=64, description="robot; the configured one if omitted"
    )
    kind: Literal["publish", "read", "service", "action", "parameters"] | None = Field(
        default=None, description="which use of that name; all of them when omitted"
    )


class ExposureChange(Result):
    """Effect on the tools."""

    added: list[str] = Field(description="added tools")
    removed: list[str] = Field(description="removed tools")
    changed: list[str] = Field(description="tools with changed limits, robots or texts")


@dataclass(frozen=True, kw_only=True, slots=True)
class Admin:
    """Client that changes the exposure, for the audit; `tool` and `arguments` are those of the
    call.
    """

    who: str
    role: str
    tool: str
    arguments: dict[str, object]


class Exposing(Protocol):
    """Interface behind the two tools, implemented by the feature."""

    def expose(self, entry: ExposeConfig, admin: Admin) -> ExposureChange: ...

    def unexpose(
        self, robot: str | None, name: str, kind: str | None, admin: Admin
    ) -> ExposureChange: ...


def exposing_tools(path: Exposing, local_may: bool) -> list[Tool]:
    """Create both tools.

    Args:
        path: performs the changes.
        local_may: also permit clients without a token (stdio, loopback). Otherwise any agent
            started on this machine could expose everything, which would make the allow list
            useless.
    """

    def admin_of(context: CallContext, tool: str, arguments: Arguments) -> Admin:
        if Holder.is_local(context.who) and not local_may:
            raise RefusedError(
                f"{tool} needs a token with the role '{Role.ADMIN}'; {context.who} has none.",
                hint="Connect over HTTP with such a token, or set expose_without_token in "
                "[direct].",
                rule="role",
            )
        given = arguments.model_dump(mode="json", exclude_unset=True)
        return Admin(who=context.who, role=context.role, tool=tool, arguments=given)

    async def expose(arguments: ExposeEndpoint, context: CallContext) -> ExposureChange:
        admin = admin_of(context, "expose_endpoint", arguments)
        return await context.run(lambda _: path.expose(arguments, admin))

    async def unexpose(arguments: UnexposeEndpoint, context: CallContext) -> ExposureChange:
        admin = admin_of(context, "unexpose_endpoint", arguments)
        return await context.run(
            lambda _: path.unexpose(arguments.robot, arguments.name, arguments.kind, admin)
        )

    return [
        _tool(
            "expose_endpoint",
            "Expose an endpoint",
            "Let agents use a ROS topic, service, action "
            "or a node's "
            "parameters, or tighten the limits of one that they may use: an [[expose]] entry of "
            "the configuration, "
            "checked in the same way, that lasts until the server ends. Clients are told that the "
            "tools changed.",
            ExposeEndpoint,
            expose,
        ),
        _tool(
            "unexpose_endpoint",
            "Withdraw an endpoint",
            "Take an endpoint away from agents until "
            "the server ends or "
            "it is exposed again, whether it was exposed at run time, by the configuration, by a "
            "profile or found by a "
            "pattern. Motion through it is ended first.",
            UnexposeEndpoint,
            unexpose,
            destructive=True,
        ),
    ]


A = TypeVar("A", bound=Arguments)


def _tool(
    name: str,
    title: str,
    text: str,
    arguments: type[A],
    handler: Callable[[A, CallContext], Awaitable[ExposureChange]],
    destructive: bool = False,
) -> Tool[A]:
    return Tool(
        name=name,
        title=title,
        description=text,
        arguments=arguments,
        result=ExposureChange,
        handler=handler,
        destructive=destructive,
        idempotent=True,
        role=Role.ADMIN,
    )
