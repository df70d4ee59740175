"""The feature: reports unknown types in the graph to agents, with a remedy."""

from __future__ import annotations

from collections.abc import Sequence

from pydantic import BaseModel, Field

from rn_interfaces.graph import is_known, uses
from rn_interfaces.store import DefinitionStore
from roboneuron import Arguments, CallContext, Feature, Host, Result, Tool

_MOST_TOPICS = 5
HOW = (
    "A person types `roboneuron ros learn graph` where this server runs, or `roboneuron ros learn "
    "FOLDER` with the robot's .msg, .srv and .action files; then the types can be exposed."
)


class ListUnknownTypes(Arguments):
    """Arguments of list_unknown_types."""

    entries: int = Field(default=50, ge=1, le=200, description="Most entries.")


class UnknownType(BaseModel):
    """A type of the graph that this server cannot read or write."""

    type: str
    used_by: list[str] = Field(description="topics, services and actions; the first ones")


class UnknownTypes(Result):
    """Types in the graph that this server does not know."""

    unknown: list[UnknownType]
    more: int = Field(description="unknown types that are left out")
    known: int = Field(description="how many types of the graph are known")
    learnt: list[str] = Field(description="known types of the graph that are not compiled here")
    how: str = Field(description="how to learn unknown ones; empty when there are none")


class Interfaces(Feature[None]):
    """Adds one tool; imports of learnt types work without it (`rn_interfaces.finder`)."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return the tool."""

        async def unknown(arguments: ListUnknownTypes, context: CallContext) -> UnknownTypes:
            return await context.run(lambda _: look(host, DefinitionStore(), arguments.entries))

        return [
            Tool(
                name="list_unknown_types",
                title="List unknown ROS types",
                description="Types of the ROS graph that are unknown here, with their topics, and "
                "how to learn them.",
                arguments=ListUnknownTypes,
                result=UnknownTypes,
                handler=unknown,
                read_only=True,
                idempotent=True,
                seldom=True,
            )
        ]


def look(host: Host, store: DefinitionStore, entries: int) -> UnknownTypes:
    """Compare the graph with the compiled and learnt types, without importing any."""
    found = uses(host.graph)
    unknown = {name: topics for name, topics in found.items() if not is_known(store, name)}
    listed = [
        UnknownType(type=str(name), used_by=topics[:_MOST_TOPICS])
        for name, topics in list(unknown.items())[:entries]
    ]
    known = found.keys() - unknown.keys()
    return UnknownTypes(
        unknown=listed,
        more=len(unknown) - len(listed),
        known=len(known),
        learnt=[str(name) for name in sorted(known) if store.has(name)][:entries],
        how=HOW if unknown else "",
    )
