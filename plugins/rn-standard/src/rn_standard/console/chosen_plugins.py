"""Plugins that a command refers to: those not disabled by a configuration, and those with a given
name.
"""

from __future__ import annotations

from argparse import ArgumentParser
from pathlib import Path

from roboneuron import ConfigurationError, nearest
from roboneuron.command import Offer, PluginRecord
from roboneuron.feature import Registry


def add_config(parser: ArgumentParser) -> None:
    """Add --config, for `read_disabled`."""
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="a roboneuron.toml whose `disabled_plugins` apply",
    )


def read_disabled(config: Path | None) -> tuple[str, ...]:
    """Read `disabled_plugins` of a configuration file, without validating the rest of it."""
    if config is None:
        return ()
    from roboneuron.feature import reading  # heavy: only for a file

    names = reading.read_tables(config).get("disabled_plugins", [])
    if not (isinstance(names, list) and all(isinstance(n, str) for n in names)):
        raise ConfigurationError(
            f"disabled_plugins in {config} is {names!r}, expected a list of names of plugins."
        )
    return tuple(names)


def find(
    registry: Registry, name: str, kind: str | None = None
) -> list[tuple[PluginRecord, tuple[Offer, ...]]]:
    """Find the plugins that `name` refers to, with their offers: all for the name of a plugin or
    distribution, else those with that name.

    Raises:
        ConfigurationError: the name (of that kind) is unknown; suggests the nearest.
    """
    found: list[tuple[PluginRecord, tuple[Offer, ...]]] = []
    names: set[str] = set()
    for record in registry.plugins:
        offers = tuple(o for o in record.offers if kind is None or o.spec.kind == kind)
        whole = name in (record.name, record.distribution)
        named = offers if whole else tuple(o for o in offers if o.spec.name == name)
        names |= {record.name, record.distribution, *(o.spec.name for o in offers)}
        if named or whole:
            found.append((record, named))
    if not found:
        hint = nearest(name, names, "See `roboneuron plugins list`.")
        of_kind = f" of kind {kind}" if kind else ""
        raise ConfigurationError(f"No installed plugin or offer{of_kind} is {name!r}.", hint=hint)
    return found
