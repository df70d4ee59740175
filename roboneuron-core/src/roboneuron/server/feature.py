"""Features: what an installed plugin adds to the server."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from roboneuron.server.host import Host
    from roboneuron.server.tool import DerivedTool, Tool

OptionsT = TypeVar("OptionsT")


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

    def tools(self, host: Host) -> Sequence[Tool[Any] | DerivedTool]:
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

    def close(self) -> None:
        """Release everything; may be called twice and before `start`."""
