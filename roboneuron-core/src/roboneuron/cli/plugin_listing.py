"""`roboneuron plugins list`: a table for people, a document with a stable schema for programs."""

from __future__ import annotations

import json
from collections.abc import Sequence

from roboneuron import __version__
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
"""Colour of each status in tables."""


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
    return json.dumps(to_document(registry), indent=2) + "\n"


def print_table(registry: Registry) -> None:
    """Write the table to stdout, and below it what to do about each plugin that is not ready."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    if not registry.plugins:
        console.print("No plugins are installed. Try: pip install rn-robot-fr3 rn-backend-servo rn-controller-urdf")
        return
    table = Table(box=None, pad_edge=False, header_style="bold", collapse_padding=True)
    for column in ("KIND", "NAME", "STATUS", "PLUGIN"):
        table.add_column(column, no_wrap=True)
    table.add_column("SUMMARY", overflow="fold")
    for kind, name, status, plugin, summary in _rows(registry):
        table.add_row(kind, Text(name, style="bold"), Text(status, style=STYLES[status]), plugin, Text(summary))
    console.print(table)
    for record in troubled(registry):
        console.print()
        console.print(Text.assemble((record.distribution, "bold"), " is ", (record.status, STYLES[record.status])))
        console.print(Text(f"  {record.reason}"))
        if record.traceback:
            console.print(Text(f"  traceback: roboneuron plugins show {record.distribution}", style="dim"))


def _rows(registry: Registry) -> Sequence[tuple[str, str, Status, str, str]]:
    rows: list[tuple[str, str, Status, str, str]] = []
    for record in registry.plugins:
        plugin = f"{record.distribution} {record.version}".strip()
        offers = offers_of(registry, record)
        rows += [(o.spec.kind, o.spec.name, o.status, plugin, o.spec.summary) for o in offers]
        if not offers:
            rows.append(("-", "-", record.status, plugin, ""))
    return sorted(rows)
