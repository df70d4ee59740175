"""Installed plugins: what each offers, whether it can be used, and whether it keeps its contract."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

from roboneuron.cli.commands import load_command, run_command
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import KINDS

CHECK = "plugins-check"
"""The command, of whatever plugin offers it, that `roboneuron plugins check` hands over to."""


def configure(parser: ArgumentParser) -> None:
    """Arguments of `roboneuron plugins`."""
    parser.add_argument("--config", type=Path, metavar="FILE", help="a roboneuron.toml whose `disabled_plugins` apply")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    listing = actions.add_parser("list", help="a table of all plugins and what they offer")
    listing.add_argument("--json", action="store_true", help="machine-readable, see docs/reference/plugins-list.md")
    listing.add_argument(
        "--strict", action="store_true", help="exit with 1 unless every plugin that is not disabled is ready"
    )

    detail = actions.add_parser("show", help="everything about one plugin, or about one thing it offers")
    detail.add_argument("name", metavar="NAME", help="a distribution (rn-robot-fr3) or an offer (fr3)")
    detail.add_argument("--kind", choices=sorted(KINDS), help="look at offers of this kind only")

    # The command that does it parses its words itself: here all are arguments, also those that begin with a hyphen.
    check = actions.add_parser(
        "check", help="run the contract rules against a plugin", add_help=False, prefix_chars="\0"
    )
    check.add_argument("words", nargs="*")


def run(arguments: Namespace) -> int:
    """Run one action of `roboneuron plugins`."""
    registry = discover(read_disabled(arguments.config))
    if arguments.action == "list":
        return _list(registry, as_json=arguments.json, strict=arguments.strict)
    if arguments.action == "show":
        from roboneuron.cli.plugin_detail import show

        return show(registry, arguments.name, arguments.kind)
    config = () if arguments.config is None else ("--config", str(arguments.config))
    return run_command(load_command(CHECK, registry), "roboneuron plugins check", (*config, *arguments.words))


def _list(registry: Registry, *, as_json: bool, strict: bool) -> int:
    from roboneuron.cli import plugin_listing

    if as_json:
        sys.stdout.write(plugin_listing.to_json(registry))
    else:
        plugin_listing.print_table(registry)
    return 1 if strict and plugin_listing.troubled(registry) else 0


def read_disabled(config: Path | None) -> tuple[str, ...]:
    """`disabled_plugins` of a configuration file, read without the models that check the rest of it."""
    if config is None:
        return ()
    import tomllib

    from roboneuron.errors import ConfigurationError

    try:
        names = tomllib.loads(config.read_text(encoding="utf-8")).get("disabled_plugins", [])
    except OSError as error:
        raise ConfigurationError(f"{config} cannot be read: {error.strerror}.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{config} is no valid TOML: {error}.") from error
    if not (isinstance(names, list) and all(isinstance(n, str) for n in names)):
        raise ConfigurationError(f"disabled_plugins in {config} is {names!r}, expected a list of distribution names.")
    return tuple(names)
