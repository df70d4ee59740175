"""The command `roboneuron ros`."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rn_interfaces.store import DefinitionStore, Origin, parse_name
from roboneuron import ConfigurationError, foreign

if TYPE_CHECKING:
    from rn_interfaces.learning import Learnt

GRAPH = "graph"
_MOST_OF_LINE = 1000


class Ros:
    """Learn ROS interfaces from their definitions, and show learnt ones."""

    def configure(self, parser: ArgumentParser) -> None:
        """Arguments of `roboneuron ros`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="what to do (each: --help)"
        )
        learn = actions.add_parser("learn", help="keep the definitions of interfaces")
        learn.add_argument(
            "sources",
            nargs="+",
            metavar="SOURCE",
            help='"graph": what nodes that run now say about types that are unknown here; or a '
            "folder, tarball or MCAP file",
        )
        listing = actions.add_parser("list", help="what is learnt, and where from")
        listing.add_argument("--json", action="store_true", help="for programs")
        show = actions.add_parser("show", help="the definition of a learnt interface")
        show.add_argument("type", metavar="TYPE", help="package/kind/Name")
        forget = actions.add_parser("forget", help="remove a learnt package")
        forget.add_argument("package", metavar="PACKAGE", help="such as weld_msgs")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron ros`."""
        store = DefinitionStore()
        if arguments.action == "learn":
            return _learn(store, arguments.sources)
        if arguments.action == "list":
            return list_learnt(store.origins(), arguments.json)
        if arguments.action == "forget":
            return _forget(store, arguments.package)
        return _show(store, arguments.type)


def _learn(store: DefinitionStore, sources: Sequence[str]) -> int:
    from rn_interfaces.found import FoundDefinitions
    from rn_interfaces.learning import learn  # heavy
    from rn_interfaces.sources import definitions
    from rn_interfaces_learning.nodes import ask_nodes, with_graph

    found = FoundDefinitions()
    for source in sources:
        if source == GRAPH and not Path(source).exists():
            found.update(with_graph(lambda graph: ask_nodes(graph, store)))
        else:
            found.update(definitions(Path(source)))
    learnt = learn(store, found)
    _report(learnt)
    return 1 if learnt.refused else 0


def _report(learnt: Learnt) -> None:
    lines = [f"{name}  {found}" for name, found in sorted(learnt.added.items())]
    lines += [f"{package}  is compiled here already" for package in sorted(learnt.compiled)]
    for name, (reason, instead, source) in sorted(learnt.refused.items()):
        lines.append(f"{name}  refused: {reason} {instead}".rstrip())
        if source:
            lines.append(f"  in {source}")
    counted = (
        f"{len(learnt.added)} learnt, {len(learnt.known)} known, {len(learnt.refused)} refused."
    )
    _write([*lines, counted])


def _write(lines: Sequence[str]) -> None:
    """Write lines, which contain words of the files and nodes that were read."""
    sys.stdout.write("".join(f"{foreign.printable(line, _MOST_OF_LINE)}\n" for line in lines))


def list_learnt(origins: Mapping[str, Origin], as_json: bool) -> int:
    """Print what is learnt."""
    if as_json:
        facts = {name: origin._asdict() for name, origin in sorted(origins.items())}
        sys.stdout.write(json.dumps(facts, indent=2) + "\n")
        return 0
    if not origins:
        sys.stdout.write("Nothing is learnt. Try `roboneuron ros learn graph`.\n")
    width = max(map(len, origins), default=0)
    for name, origin in sorted(origins.items()):
        _write([f"{name:<{width}}  {origin.type_hash[:19]}  {origin.source}"])
    return 0


def _show(store: DefinitionStore, type_name: str) -> int:
    name = parse_name(type_name)
    if not store.has(name):
        raise ConfigurationError(
            f"{name} is not learnt.",
            hint="`roboneuron ros list` shows what is; `roboneuron ros describe` shows compiled "
            "types.",
        )
    origin = store.origin(name)
    head = (f"# {name}", f"# {origin.type_hash}", f"# from {origin.source}")
    _write([*head, *store.text(name).splitlines()])
    return 0


def _forget(store: DefinitionStore, package: str) -> int:
    count = store.forget(package)
    if not count:
        raise ConfigurationError(f"Nothing of a package {package!r} is learnt.")
    sys.stdout.write(f"{count} interfaces of {package} are forgotten.\n")
    return 0
