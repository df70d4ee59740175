"""`roboneuron plugins list`: a table for people, a document with a stable schema for programs."""

from __future__ import annotations

import os
import shutil
import sys
import textwrap
from collections.abc import Sequence

from roboneuron import __version__
from roboneuron.plugins.packages import START, install_command
from roboneuron.plugins.record import Offer, PluginRecord, Status
from roboneuron.plugins.registry import Registry
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
"""Colour of each status in tables drawn by rich."""
_CODES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33"}
_NARROWEST = 24
"""Columns a summary gets even on a terminal too narrow for it."""


def troubled(registry: Registry) -> tuple[PluginRecord, ...]:
    """Plugins that are not ready, those left out on purpose aside."""
    return tuple(p for p in registry.plugins if p.status not in (Status.READY, Status.DISABLED))


def offers_of(registry: Registry, record: PluginRecord) -> tuple[Offer, ...]:
    """What one plugin offers, in the order of its hooks."""
    return tuple(
        next(o for o in registry.offers(spec.kind) if o.spec is spec and o.distribution == record.distribution)
        for spec in record.specs
    )


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
                "offers": [_offer_document(o) for o in offers_of(registry, p)],
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


def to_json(registry: Registry) -> str:
    """The document of `to_document` as text."""
    import json

    return json.dumps(to_document(registry), indent=2) + "\n"


def print_table(registry: Registry, *, width: int | None = None, has_colour: bool | None = None) -> None:
    """Write the table to stdout, and below it what to do about each plugin that is not ready.

    Drawn here rather than by rich, whose import and rendering take longer than everything else that listing does.

    Args:
        registry: what to list.
        width: columns to fill; the terminal's when None.
        has_colour: use colours; only on a terminal, and not with NO_COLOR, when None.
    """
    if not registry.plugins:
        print(f"No plugins are installed. For a start: {install_command(*START)}")
        return
    if has_colour is None:
        has_colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
    columns = shutil.get_terminal_size().columns if width is None else width
    rows = _rows(registry)
    heading = ("KIND", "NAME", "STATUS", "PLUGIN", "SUMMARY")
    widths = [max(len(row[i]) for row in (heading, *rows)) for i in range(4)]
    indent = sum(widths) + 2 * len(widths)
    room = max(_NARROWEST, columns - indent)
    print(_paint(_line(heading, widths), "bold", has_colour))
    for row in rows:
        first, *rest = textwrap.wrap(row[4], room) or [""]
        status = f"{row[2]:<{widths[2]}}"
        line = _line((*row[:4], first), widths)
        print(line.replace(status, _paint(status, STYLES[row[2]], has_colour), 1))
        for text in rest:
            print(" " * indent + text)
    for record in troubled(registry):
        print(f"\n{record.distribution} is {_paint(record.status, STYLES[record.status], has_colour)}")
        for text in textwrap.wrap(record.reason, max(_NARROWEST, columns - 2)):
            print(f"  {text}")
        if record.traceback:
            print(_paint(f"  traceback: roboneuron plugins show {record.distribution}", "dim", has_colour))


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    padded = [f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=False)]
    return "  ".join([*padded, cells[-1]]).rstrip()


def _paint(text: str, style: str, has_colour: bool) -> str:
    codes = ";".join(_CODES[word] for word in style.split())
    return f"\x1b[{codes}m{text}\x1b[0m" if has_colour else text


def _rows(registry: Registry) -> Sequence[tuple[str, str, Status, str, str]]:
    rows: list[tuple[str, str, Status, str, str]] = []
    for record in registry.plugins:
        plugin = f"{record.distribution} {record.version}".strip()
        offers = offers_of(registry, record)
        rows += [(o.spec.kind, o.spec.name, o.status, plugin, o.spec.summary) for o in offers]
        if not offers:
            rows.append(("-", "-", record.status, plugin, ""))
    return sorted(rows)
