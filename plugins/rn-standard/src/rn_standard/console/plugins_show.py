"""The command `roboneuron plugins show`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass

from rn_standard.console.chosen_plugins import add_config, find, read_disabled
from rn_standard.console.options import describe_options
from rn_standard.console.plugins_list import MOST_OF_REASON, STYLES
from roboneuron import DriverSpec, RobotSpec, Spec, foreign
from roboneuron.command import PLUGIN_KINDS, Offer, Status, availability, discover
from roboneuron.feature import Registry, loading


class PluginsShow:
    """Show everything about one plugin, or about one thing it offers, and the traceback of what
    failed.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron plugins show`."""
        add_config(parser)
        parser.add_argument(
            "name", metavar="NAME", help="a plugin (rn-robot-fr3), a distribution or an offer (fr3)"
        )
        parser.add_argument(
            "--kind", choices=sorted(PLUGIN_KINDS), help="look at offers of this kind only"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron plugins show`."""
        return show(discover(read_disabled(arguments.config)), arguments.name, arguments.kind)


def show(registry: Registry, name: str, kind: str | None) -> int:
    """Print all facts about `name` and return the exit status."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False, soft_wrap=True)
    for record, offers in find(registry, name, kind):
        heading = Text.assemble((f"{record.name} {record.version}".strip(), "bold"), "  ")
        console.print(heading.append(record.status, style=STYLES[record.status]))
        if record.distribution != record.name:
            console.print(Text(f"  distribution: {record.distribution}"))
        console.print(Text(f"  module: {record.module}"))
        if record.reason:
            console.print(Text(f"  reason: {foreign.printable(record.reason, MOST_OF_REASON)}"))
        for offer in offers:
            console.print(
                Text.assemble("\n  ", offer.spec.kind, " ", (offer.spec.name, "bold"), "  ").append(
                    offer.status, style=STYLES[offer.status]
                )
            )
            for key, value in facts(offer.spec):
                console.print(Text(f"    {key}: {foreign.printable(str(value), MOST_OF_REASON)}"))
            for line in _options(offer):
                console.print(Text(f"    {foreign.printable(line, MOST_OF_REASON)}"))
        if record.traceback:
            lines = [foreign.printable(line) for line in record.traceback.rstrip().split("\n")]
            console.print(Text("\n" + "\n".join(lines), style="dim"))
    return 0


def _options(offer: Offer) -> Iterator[str]:
    """Options in `[plugins.<name>]`, for every part of the offer that has options and can be
    imported.
    """
    if offer.status is not Status.READY:
        return
    specs: list[Spec | DriverSpec] = [offer.spec]
    if isinstance(offer.spec, RobotSpec):
        specs += [
            driver
            for driver in offer.spec.drivers
            if all(map(availability.present, driver.requires))
        ]
    for spec in specs:
        model = loading.load_options_model(spec)
        if model is None:
            continue
        owner = "" if spec is offer.spec else f" of driver {spec.name}"
        yield f"options{owner}, in [plugins.{offer.spec.name}]:"
        for option in describe_options(model):
            default = "required" if option.default is None else f"default {option.default}"
            only = "; configuration only" if option.restricted else ""
            yield f"  {option.key}  ({option.type}; {default}{only})  {option.meaning}".rstrip()


def facts(value: object, skip: Sequence[str] = ("name",)) -> Iterator[tuple[str, str]]:
    """The fields of a descriptor as text, in the order of its class; empty ones are left out."""
    for field in fields(value):  # type: ignore[arg-type]
        item: object = getattr(value, field.name)
        if field.name in skip or item in ((), "", None):
            continue
        yield field.name, _text(item)


def _text(item: object) -> str:
    if isinstance(item, tuple):
        nested = any(is_dataclass(part) for part in item)
        return ("; " if nested else ", ").join(_text(part) for part in item)
    if is_dataclass(item):
        return ", ".join(f"{key}={text}" for key, text in facts(item, skip=()))
    if isinstance(item, bool):
        return "yes" if item else "no"
    return str(item)
