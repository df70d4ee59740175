"""Features: what an installed plugin adds to the server."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

if TYPE_CHECKING:
    from anyio import Event
    from mcp.server.context import ServerRequestContext
    from mcp.types import CallToolRequestParams

    from roboneuron.config import Config
    from roboneuron.server.host import Host
    from roboneuron.server.tool import Tool

OptionsT = TypeVar("OptionsT")
Transport: TypeAlias = "Callable[[Event], Awaitable[None]]"
"""Serves clients on the event loop until the event is set."""


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


class Feature(Generic[OptionsT]):
    """Base of all features; override what the feature needs.

    Built as `target(options)` in the server's process: `options` is an instance of the descriptor's `config`, or None
    when it names none. The constructor has no effect; `start` does the work and `close` undoes it.
    """

    def __init__(self, options: OptionsT) -> None:
        self.options = options

    @property
    def identifies_clients(self) -> bool:
        """Whether it tells clients apart by what they alone know, such as a token."""
        return False

    def check(self, config: Config) -> None:
        """Check what the options alone do not tell (files, environment); for `config check` and before `listen`.

        Raises:
            ConfigurationError: the server would not work with it.
        """

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """Tools for the agent. Called once, before clients are served; `host` may be kept."""
        return ()

    def resources(self, host: Host) -> Sequence[Resource]:
        """Resources for the agent. Called once, after `tools`."""
        return ()

    def start(self, host: Host) -> None:
        """Begin to work: threads, subscriptions. Called once, when the server begins to serve; must return quickly.

        Raises:
            RoboNeuronError: it cannot work; the server goes on without it unless the configuration names it.
        """

    async def ask(
        self, request: ServerRequestContext[Any, Any], params: CallToolRequestParams, question: str
    ) -> bool | None:
        """Ask the person behind the client of a tool call; whether they agreed, None when this feature cannot ask.

        Raises:
            UnfinishedCallError: the question goes out as the answer to the call, which is then made again.
        """
        return None

    def listen(self, host: Host) -> Transport:
        """Begin to listen for clients. Called once, after `tools`, if `[server] transport` is one of the descriptor's.

        Modules and ROS are not started yet. `roboneuron.server.access` says what a transport leaves with each request.

        Raises:
            ConfigurationError: it cannot, such as for a port that is in use.
        """
        raise NotImplementedError(f"{type(self).__name__} serves no transport.")

    def close(self) -> None:
        """Release everything; may be called twice and before `start`."""
