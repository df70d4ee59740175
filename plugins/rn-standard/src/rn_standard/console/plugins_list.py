"""The command `roboneuron plugins list`."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence

from rn_standard.console.chosen_plugins import add_config, read_disabled
from roboneuron import CONTRACT_VERSION, __version__, foreign, install_command
from roboneuron.command import Offer, PluginRecord, Status, all_commands, availability, discover
from roboneuron.feature import Registry

SCHEMA_VERSION = 1
MOST_OF_REASON = 2000
"""Characters of a text of a plugin or of its failure that are shown."""
"""Version of the JSON document, incremented when a key changes its meaning or is removed; keys may
be added at any time.
"""
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
_MOST_NAMES, _FIRST_NAMES = 40, 4
"""Number of offers of one kind from which the short list is truncated, and the number it then
shows.
"""
_NARROWEST = 24
"""Minimum width of a summary [columns], even on a narrower terminal."""


class PluginsList:
    """List the installed plugins, what they offer, and what to do about each that is not ready."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron plugins list`."""
        add_config(parser)
        told = "show each thing that they offer, with a summary; log more to standard error"
        parser.add_argument("-v", "--verbose", action="count", default=0, help=told)
        parser.add_argument(
            "--json",
            action="store_true",
            help="machine-readable, see docs/reference/plugins-list.md",
        )
        parser.add_argument(
            "--strict",
            action="store_true",
            help="exit with 1 unless every plugin that is not disabled is ready",
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron plugins list`."""
        registry = discover(read_disabled(arguments.config))
        if arguments.json:
            import json

            print(json.dumps(to_document(registry), indent=2))
        elif arguments.verbose and registry.plugins:
            print_table(registry)
        else:
            print_short(registry)
        return 1 if arguments.strict and _troubled(registry) else 0


def _troubled(registry: Registry) -> tuple[PluginRecord, ...]:
    """Plugins that are not ready, without deliberately disabled ones."""
    return tuple(p for p in registry.plugins if p.status not in (Status.READY, Status.DISABLED))


def to_document(registry: Registry) -> dict[str, object]:
    """Convert the listing to plain data; described by docs/reference/plugins-list.schema.json."""
    return {
        "schema_version": SCHEMA_VERSION,
        "core": __version__,
        "contract": CONTRACT_VERSION,
        "plugins": [
            {
                "name": p.name,
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


def print_short(registry: Registry) -> None:
    """Print ready offers by kind, then the others with remedies, then uninstalled ones."""
    if not registry.plugins:
        command = install_command()
        print(f"No plugins are installed. For a start: {command}")
        return
    words = {command.name: command.words for command in all_commands(registry)}
    ready: dict[str, list[str]] = {}
    for offer in sorted(registry.all_offers, key=lambda o: (o.spec.kind, o.spec.name)):
        if offer.status is Status.READY:
            ready.setdefault(offer.spec.kind, []).append(
                words.get(offer.spec.name, offer.spec.name)
            )
    indent = max((len(kind) for kind in ready), default=0) + 2
    print(_paint("READY", "bold"))
    for kind, every in ready.items():
        names = _grouped(every)
        shown = names if len(names) <= _MOST_NAMES else names[:_FIRST_NAMES]
        rest = f" and {len(names) - len(shown)} more" if len(shown) < len(names) else ""
        print(_wrapped(f"{kind:<{indent}}{', '.join(shown)}{rest}", indent))
    _print_trouble(registry)
    disabled = [record.name for record in registry.plugins if record.status is Status.DISABLED]
    if disabled:
        print("\n" + _wrapped(f"disabled by the configuration: {', '.join(disabled)}", 2))
    known = {package.partition("[")[0] for package in availability.known_names().values()}
    absent = sorted(known - {record.distribution for record in registry.plugins})
    if absent:
        print(_paint("\nNOT INSTALLED", "bold") + " (what they offer: docs/packages.md)")
        print(_wrapped(", ".join(absent), 0))
        print(_wrapped(f"One of them: {install_command(absent[0])}", 2))
    print(
        _paint(
            f"\n{len(registry.plugins)} plugins; details: roboneuron plugins list --verbose", "dim"
        )
    )


def _grouped(names: Sequence[str]) -> list[str]:
    """Commands of one group written once: "config check", "config show" -> "config check|show".
    A command with the group's own name stays before them.
    """
    groups: dict[str, list[str]] = {}
    for name in names:
        group, _, action = name.partition(" ")
        groups.setdefault(group, []).extend([action] if action else [])
    found: list[str] = []
    for group, actions in groups.items():
        if group in names:
            found.append(group)
        if actions:
            found.append(f"{group} {'|'.join(actions)}")
    return found


def print_table(registry: Registry) -> None:
    """Print the table of all offers, and below it each plugin's problems.

    It does not use rich, whose import and rendering would take longer than the rest of the command.
    """
    rows = sorted(row for record in registry.plugins for row in _rows(record))
    widths = [max(len(row[i]) for row in (_HEADING, *rows)) for i in range(4)]
    indent = sum(widths) + 2 * len(widths)
    is_narrow = _columns() - indent < _NARROWEST
    print(_paint(_line(_HEADING[: 4 if is_narrow else 5], widths), "bold"))
    for row in rows:
        summary = row[4]
        if is_narrow:
            first, rest = "", textwrap.wrap(summary, max(_NARROWEST, _columns() - 4))
            indent = 4
        else:
            first, *rest = textwrap.wrap(summary, _columns() - indent) or [""]
        status = f"{row[2]:<{widths[2]}}"
        print(_line((*row[:4], first), widths).replace(status, _paint(status, STYLES[row[2]]), 1))
        for text in rest:
            print(" " * indent + text)
    _print_trouble(registry)


def _print_trouble(registry: Registry) -> None:
    """Print each plugin that is not ready, with its reasons and its offers that are ready."""
    for record in _troubled(registry):
        print(f"\n{record.name} is {_paint(record.status, STYLES[record.status])}")
        reasons = dict.fromkeys(offer.reason for offer in record.offers if offer.reason) or (
            record.reason,
        )
        for reason in reasons:
            names = [f"{o.spec.kind} {o.spec.name}" for o in record.offers if o.reason == reason]
            told = foreign.printable(reason, MOST_OF_REASON)
            print(_wrapped(f"  {', '.join(names)}: {told}" if names else f"  {told}", 2))
        if record.traceback:
            print(_paint(f"  traceback: roboneuron plugins show {record.name}", "dim"))


def _wrapped(text: str, indent: int) -> str:
    """Wrap the text to the terminal's width; a command in it is not broken within a word."""
    lead = " " * indent
    return textwrap.fill(
        text,
        max(_NARROWEST, _columns()),
        subsequent_indent=lead,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _columns() -> int:
    return shutil.get_terminal_size().columns


def _rows(record: PluginRecord) -> Sequence[tuple[str, str, Status, str, str]]:
    plugin = f"{record.name} {record.version}".strip()
    if not record.offers:
        return [("-", "-", record.status, plugin, "")]
    return [
        (o.spec.kind, o.spec.name, o.status, plugin, foreign.printable(o.spec.summary))
        for o in record.offers
    ]


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=False)]
    return "  ".join([*padded, *cells[len(padded) :]]).rstrip()


def _paint(text: str, style: str) -> str:
    """Add colours on a terminal, unless NO_COLOR is set."""
    has_colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    codes = ";".join(_CODES[word] for word in style.split())
    return f"\x1b[{codes}m{text}\x1b[0m" if has_colour else text
