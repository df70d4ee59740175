"""Types in the running graph, and those among them that are known here."""

from __future__ import annotations

from typing import Protocol

from rn_interfaces.cache import installed
from rn_interfaces.described import read_hashes
from rn_interfaces.store import DefinitionStore, Name, parse_name
from roboneuron import ConfigurationError

_PARTS = "_action/"


class Graph(Protocol):
    """Common interface of the server's `Host.graph` and `NodeGraph`."""

    def topics(self) -> dict[str, list[str]]:
        """Types by absolute topic name."""

    def services(self) -> dict[str, list[str]]:
        """Types by absolute service name."""


def is_known(store: DefinitionStore, name: Name) -> bool:
    """True if a type is compiled here or learnt."""
    folder = installed(name.package, besides=store.prefix)
    if folder is not None:
        return (folder / name.kind / f"{name.word}.json").is_file()
    return store.has(name)


def hashes_here(store: DefinitionStore, name: Name) -> dict[str, str]:
    """RIHS01 hashes of a known type and of all its parts, by full name; empty if unknown.

    Raises:
        ConfigurationError: its description is damaged.
    """
    folder = installed(name.package, besides=store.prefix) or store.share / name.package
    path = folder / name.kind / f"{name.word}.json"
    return read_hashes(path) if path.is_file() else {}


def interface_of(type_name: str) -> Name | None:
    """Interface of a graph's type or of a part of one; None for other names."""
    try:
        name = parse_name(type_name.partition("_SendGoal")[0].partition("_GetResult")[0])
    except ConfigurationError:
        try:
            return parse_name(type_name.partition("_FeedbackMessage")[0])
        except ConfigurationError:
            return None
    return name


def uses(graph: Graph) -> dict[Name, list[str]]:
    """Topics and services by interface; an action only appears under its own name."""
    found: dict[Name, set[str]] = {}
    for topic, types in {**graph.services(), **graph.topics()}.items():
        for name in filter(None, map(interface_of, types)):
            found.setdefault(name, set()).add(topic.partition(f"/{_PARTS}")[0])
    return {name: sorted(topics) for name, topics in sorted(found.items())}
