"""The command `roboneuron plugins list`."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence

from rn_console.chosen_plugins import add_config, read_disabled
from roboneuron import __version__
from roboneuron.plugins.availability import START, install_command
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Offer, PluginRecord, Registry, Status
from roboneuron.plugins.specs import CONTRACT_VERSION

SCHEMA_VERSION = 1
"""Raised when a key of the JSON document changes its meaning or goes; new keys may come at any time."""
STYLES = {
    Status.READY: "green",
    Status.DISABLED: "dim",
    Status.UNAVAILABLE: "yellow",
    Status.INCOMPATIBLE: "red",
    Status.CONFLICT: "red",
    Status.FAILED: "bold red",
}
"""Colour of each status."""
_CODES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33"}
_HEADING = ("KIND", "NAME", "STATUS", "PLUGIN", "SUMMARY")
_NARROWEST = 24
"""Columns a summary gets even on a terminal too narrow for it."""


class PluginsList:
    """List the installed plugins, what they offer, and what to do about each that is not ready."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron plugins list`."""
        add_config(parser)
        parser.add_argument("--json", action="store_true", help="machine-readable, see docs/reference/plugins-list.md")
        parser.add_argument(
            "--strict", action="store_true", help="exit with 1 unless every plugin that is not disabled is ready"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron plugins list`."""
        registry = discover(read_disabled(arguments.config))
        if arguments.json:
            import json

            print(json.dumps(to_document(registry), indent=2))
        else:
            print_table(registry)
        return 1 if arguments.strict and _troubled(registry) else 0


def _troubled(registry: Registry) -> tuple[PluginRecord, ...]:
    """Plugins that are not ready, those left out on purpose aside."""
    return tuple(p for p in registry.plugins if p.status not in (Status.READY, Status.DISABLED))


def to_document(registry: Registry) -> dict[str, object]:
    """The listing as plain data; docs/reference/plugins-list.schema.json describes it."""
    return {
        "schema_version": SCHEMA_VERSION,
        "core": __version__,
        "contract": CONTRACT_VERSION,
        "plugins": [
            {
                "distribution": p.distribution,
                "version": p.version,
                "module": p.module,
                "status": p.status.value,
                "reason": p.reason,
                "offers": [_offer_document(offer) for offer in p.offers],
            }
            for p in registry.plugins
        ],
    }


def _offer_document(offer: Offer) -> dict[str, object]:
    return {
        "kind": offer.spec.kind,
        "name": offer.spec.name,
        "summary": offer.spec.summary,
        "status": offer.status.value,
        "reason": offer.reason,
        "target": offer.spec.target,
        "config": offer.spec.config,
        "requires": [r.module for r in offer.spec.requires],
    }


def print_table(registry: Registry) -> None:
    """Write the table to stdout, in colours on a terminal (not with NO_COLOR), and below it each plugin's trouble.

    Drawn here rather than by rich, whose import and rendering take longer than everything else that listing does.
    """
    if not registry.plugins:
        print(f"No plugins are installed. For a start: {install_command(*START)}")
        return
    has_colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    columns = shutil.get_terminal_size().columns
    rows = sorted(row for record in registry.plugins for row in _rows(record))
    widths = [max(len(row[i]) for row in (_HEADING, *rows)) for i in range(4)]
    indent = sum(widths) + 2 * len(widths)
    print(_paint(_line(_HEADING, widths), "bold", has_colour))
    for row in rows:
        first, *rest = textwrap.wrap(row[4], max(_NARROWEST, columns - indent)) or [""]
        status = f"{row[2]:<{widths[2]}}"
        line = _line((*row[:4], first), widths)
        print(line.replace(status, _paint(status, STYLES[row[2]], has_colour), 1))
        for text in rest:
            print(" " * indent + text)
    for record in _troubled(registry):
        print(f"\n{record.distribution} is {_paint(record.status, STYLES[record.status], has_colour)}")
        for text in textwrap.wrap(record.reason, max(_NARROWEST, columns - 2)):
            print(f"  {text}")
        if record.traceback:
            print(_paint(f"  traceback: roboneuron plugins show {record.distribution}", "dim", has_colour))


def _rows(record: PluginRecord) -> Sequence[tuple[str, str, Status, str, str]]:
    plugin = f"{record.distribution} {record.version}".strip()
    if not record.offers:
        return [("-", "-", record.status, plugin, "")]
    return [(o.spec.kind, o.spec.name, o.status, plugin, o.spec.summary) for o in record.offers]


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=False)]
    return "  ".join([*padded, cells[-1]]).rstrip()


def _paint(text: str, style: str, has_colour: bool) -> str:
    codes = ";".join(_CODES[word] for word in style.split())
    return f"\x1b[{codes}m{text}\x1b[0m" if has_colour else text
