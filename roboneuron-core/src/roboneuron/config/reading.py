"""Parser from text to `Config`; errors name the file, the key and the nearest valid key.

Sections unknown to core belong to features; they are checked against the models of the installed
ones.
"""

from __future__ import annotations

import re
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel

from roboneuron import foreign
from roboneuron.config.models import Config, ModuleSection
from roboneuron.errors import (
    ConfigurationError,
    ForeignDataError,
    MissingDependencyError,
    PluginError,
)
from roboneuron.plugins.availability import package_of
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import (
    explain_unknown,
    load_attribute,
    load_options_model,
    option_names,
    read_table,
)
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import FeatureSpec, RobotSpec

EMBEDDED_DEFAULT = "the embedded default"
"""Name, in messages, of the configuration that is used without a file."""
_MOST_BYTES = 1 << 20
"""Largest configuration file; one with every key has 40 kB."""
_STDIO = "stdio"
"""The transport without an address."""
M = TypeVar("M", bound=BaseModel)
_UNKNOWN = re.compile(r"unknown key '([^']*)'\. Valid keys")
"""A problem of `read_table` that names no similar key."""
_MOST_PLACES = 3
"""Sections that are worth naming; `start_timeout_s` is in more."""
_PLUGIN_OPTIONS = "Options of a plugin stand under [plugins.<name>]."
KEYS = frozenset(
    name for name, field in Config.model_fields.items() if not field.exclude and name != "modules"
)
"""Top-level keys of core, except `robots`."""


def parse_config(
    text: str,
    *,
    source: str = "roboneuron.toml",
    registry: Registry | None = None,
    arguments: Namespace | None = None,
) -> Config:
    """Parse the text of a roboneuron.toml.

    Args:
        text: TOML.
        source: file name for messages.
        registry: the installed plugins; discovered if there are sections unknown to core.
        arguments: arguments of `roboneuron serve`, which override the text.

    Raises:
        ConfigurationError: not TOML, or a key or value is not valid; names file, key and the
            nearest valid key.
    """
    raw = _parse_toml(text, source)
    changes = _server_changes(raw, arguments) if arguments is not None else {}
    if changes:
        raw |= {key: {**_table(raw, key), **change} for key, change in changes.items()}
        source = f"{source} with the command line"
    return (_read_robots if "robots" in raw else parse_tables)(raw, source, registry)


def _parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse the tables of a text. Raises ConfigurationError, which names the file, if it is not
    TOML, or contains a number that is not finite.
    """
    try:
        return foreign.decode_toml(text, source)
    except ForeignDataError as error:
        raise ConfigurationError(f"{error.message}.", hint=error.hint) from error


def parse_tables(raw: Mapping[str, Any], source: str, registry: Registry | None) -> Config:
    """Parse the tables of one robot: core's own become models, those of features are checked and
    kept.

    Args:
        raw: the tables.
        source: file name for messages.
        registry: as of `parse_config`.

    Raises:
        ConfigurationError: as `parse_config`.
    """
    own = {key: value for key, value in raw.items() if key in KEYS}
    others = {key: value for key, value in raw.items() if key not in KEYS}
    if "robot" not in own:
        raise _without_robot(others, source, registry or discover())
    config = _checked(Config, own, source)
    if others:
        config = config.model_copy(update={"sections": others})
        registry = registry or discover(config.disabled_plugins)
        check_sections(config, registry, source)
        kinds = others.keys() & registry.specs(FeatureSpec).keys()
        modules = {key: others[key] for key in kinds if registry.get(FeatureSpec, key).module_kind}
        config = config.model_copy(update={"modules": modules})
    return config


def _without_robot(
    others: Mapping[str, Any], source: str, registry: Registry
) -> ConfigurationError:
    """Create the error for tables that name no robot; tables that nobody knows explain it best."""
    known = {*KEYS, *_owners(registry), "robots"}
    unknown = [explain_unknown(key, known) for key in others if key not in known]
    robots = ", ".join(sorted(registry.specs(RobotSpec))) or "none"
    return ConfigurationError(
        "\n".join(f"{source}: {told}" for told in unknown) or f"{source}: no robot is named.",
        hint=f'Write [robot] with name = "...", one of: {robots}. '
        "Or begin from `roboneuron config show`.",
    )


def _owners(registry: Registry) -> dict[str, str]:
    """Names of the features by the sections that they read."""
    return {
        key: offer.spec.name
        for offer in registry.offers("feature")
        if isinstance(offer.spec, FeatureSpec)
        for key in offer.spec.keys
    }


def _read_robots(raw: Mapping[str, Any], source: str, registry: Registry | None) -> Config:
    """Read a file with `[robots.<name>]`, with the feature that serves several robots.

    Only `disabled_plugins` is read here, to find that feature; the feature checks the rest.
    """
    disabled = raw.get("disabled_plugins")
    registry = registry or discover(tuple(disabled) if isinstance(disabled, list) else ())
    spec = fleet_feature(registry)
    read = load_attribute(spec.fleet_config or "", f"`fleet_config` of feature {spec.name!r}")
    return cast("Callable[[Mapping[str, Any], str, Registry], Config]", read)(raw, source, registry)


def fleet_feature(registry: Registry) -> FeatureSpec:
    """Return the feature that serves several robots. Raises ConfigurationError if there is none."""
    specs = registry.specs(FeatureSpec).values()
    found = next((spec for spec in specs if spec.fleet is not None), None)
    return found or _named_feature("[robots.<name>]", "fleet", registry)


def robot_folder(state_directory: Path, name: str = "*") -> Path:
    """Folder of one robot among several, with its logs, latch and audit.

    Args:
        state_directory: state directory of the server.
        name: name of the robot; by default a pattern for all.
    """
    return state_directory / "robots" / name


def default_text() -> str:
    """Text of the embedded default configuration."""
    return files("roboneuron").joinpath("data/default.toml").read_text(encoding="utf-8")


def load_config(
    path: Path | None = None,
    registry: Registry | None = None,
    arguments: Namespace | None = None,
) -> Config:
    """Read `path`, or the embedded default when None; `registry` as in `parse_config`.

    Args:
        arguments: arguments of `roboneuron serve`, which override the file.

    Raises:
        ConfigurationError: the file cannot be read or is not valid, or the arguments are not.
    """
    text = default_text() if path is None else _read_text(path)
    source = EMBEDDED_DEFAULT if path is None else str(path)
    config = parse_config(text, source=source, registry=registry, arguments=arguments)
    return config if path is None else _beside(config, path.absolute().parent)


def _beside(config: Config, folder: Path) -> Config:
    """The configuration with the relative paths of declared arms in the folder of its file."""
    robots = {name: _beside(one, folder) for name, one in config.robots.items()}
    if config.robot.arm is None and not robots:
        return config
    arm = None if config.robot.arm is None else config.robot.arm.beside(folder)
    robot = config.robot.model_copy(update={"arm": arm})
    return config.model_copy(update={"robot": robot, "robots": robots})


def read_state_directory(path: Path) -> str | None:
    """Read `supervisor.state_directory` of a file, None if it sets none; for commands that must
    work despite other errors in the file.

    No plugin is discovered, and nothing else in the file is checked.

    Raises:
        ConfigurationError: the file cannot be read, is not TOML, or the value is not text.
    """
    section = read_tables(path).get("supervisor")
    found = section.get("state_directory") if isinstance(section, dict) else None
    if found is not None and not isinstance(found, str):
        raise ConfigurationError(
            f"{path}: supervisor.state_directory = {found!r}: input should be a valid string."
        )
    return found


def read_tables(path: Path) -> dict[str, Any]:
    """Read the tables of a file, unchecked. Raises ConfigurationError as `load_config`, or if it is
    not TOML.
    """
    return _parse_toml(_read_text(path), str(path))


def _read_text(path: Path) -> str:
    """Read a file's text. Raises ConfigurationError with a remedy if it cannot be read."""
    try:
        return foreign.read_text(path, most_bytes=_MOST_BYTES)
    except FileNotFoundError as error:
        raise ConfigurationError(
            f"There is no file {path.absolute()}.",
            hint=f"Make one to edit: roboneuron config show > {path}. Or leave --config out.",
        ) from error
    except ForeignDataError as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error.message}.", hint=error.hint
        ) from error


def check_sections(config: Config, registry: Registry, source: str = "roboneuron.toml") -> None:
    """Check the sections of all features, and that each section has a feature.

    Args:
        config: configuration with the sections.
        registry: the installed plugins.
        source: file name for messages.

    Raises:
        ConfigurationError: an unknown key, an invalid value, or a section of a feature that cannot
            be used, with the reason.
    """
    owners = _owners(registry)
    used: dict[str, FeatureSpec] = {}
    for key in config.sections:
        name = owners.get(key, key.replace("_", "-"))
        if key not in owners and package_of("feature", name) is None:
            raise ConfigurationError(
                f"{source}: {explain_unknown(key, {*KEYS, *owners})}",
                hint=f"{_PLUGIN_OPTIONS} If it belongs to a feature, that is not installed: see "
                "`roboneuron plugins list`.",
            )
        used[name] = _named_feature(f"{source}: the section {key!r}", name, registry)
    for spec in used.values():
        feature_options(spec, config, source)


def _named_feature(place: str, name: str, registry: Registry) -> FeatureSpec:
    """Return the feature named at `place`. Raises ConfigurationError with the reason if it cannot
    be used.
    """
    try:
        return registry.get(FeatureSpec, name)
    except ConfigurationError as error:
        raise ConfigurationError(f"{place}: {error.message}", hint=error.hint) from error


def feature_options(
    spec: FeatureSpec, config: Config, source: str = "roboneuron.toml"
) -> BaseModel | None:
    """The options of a feature: its sections of the configuration, or their defaults.

    Args:
        spec: descriptor of the feature.
        config: configuration with the sections.
        source: file name for messages.

    Returns:
        An instance of the feature's model; None for a feature without options.

    Raises:
        ConfigurationError: a key or value is not valid.
        PluginError, MissingDependencyError: the model cannot be loaded.
    """
    model = load_options_model(spec)
    if model is None:
        return None
    # several sections form one model, with a field for each; a single one is the model itself
    if not spec.sections:
        key = spec.keys[0]
        values = config.sections.get(key, {})
        if spec.module_kind is not None and isinstance(values, dict):
            common = {k: v for k, v in values.items() if k in ModuleSection.model_fields}
            _checked(ModuleSection, common, source, key)
            values = {k: v for k, v in values.items() if k not in common}
        return _checked(model, values, source, key)
    return _checked(
        model, {key: config.sections[key] for key in spec.keys if key in config.sections}, source
    )


def _checked(model: type[M], values: object, source: str, place: str = "") -> M:
    """Parse a table of a file as its model; `place` is its key. Raises ConfigurationError; every
    line names the file.
    """
    made, problems = read_table(model, values, place)
    if made is None:
        told = "\n".join(f"{source}: {problem}" for problem in problems)
        strange = [key for problem in problems for key in _UNKNOWN.findall(problem)]
        hint = " ".join([*_places_of(strange), _PLUGIN_OPTIONS]) if strange else ""
        raise ConfigurationError(told, hint=hint)
    return made


def _places_of(strange: Sequence[str]) -> Iterator[str]:
    """Yield the sections that have an unknown key, for each key that some section has."""
    sections = {name: option_names(Config, [name]) for name in KEYS}
    for spec in discover().specs(FeatureSpec).values():
        try:
            model = load_options_model(spec)
        except (PluginError, MissingDependencyError):
            continue  # explained where that feature is used
        for name in spec.keys if model is not None else ():
            path = [name] if spec.sections else []
            sections[name] = option_names(cast("type[BaseModel]", model), path)
    for key in strange:
        word = key.rpartition(".")[2]
        places = sorted(f"[{name}]" for name, keys in sections.items() if word in keys)
        if 0 < len(places) <= _MOST_PLACES:
            yield f"{word!r} is a key of {', '.join(places)}."


def transport_feature(transport: str, registry: Registry) -> FeatureSpec:
    """Return the feature that serves a transport.

    Raises:
        ConfigurationError: there is none; names the package that provides it.
    """
    served = {
        name: spec for spec in registry.specs(FeatureSpec).values() for name in spec.transports
    }
    if transport in served:
        return served[transport]
    # by convention it has the transport's name: the error explains its absence
    _named_feature(f"transport = {transport!r}", transport, registry)
    raise ConfigurationError(
        f"transport = {transport!r}: nothing serves it; choose one of: "
        f"{', '.join(served) or 'none'}."
    )


def _server_changes(raw: Mapping[str, Any], arguments: Namespace) -> dict[str, dict[str, Any]]:
    """Server settings from the command line, by section.

    Args:
        raw: tables of the file.
        arguments: of `roboneuron serve`; None keeps the file's value.

    Raises:
        ConfigurationError: an address was given for stdio.
    """
    changes: dict[str, dict[str, Any]] = {
        spec.keys[0]: {spec.switch: True} for spec in getattr(arguments, "switches", None) or ()
    }
    named = arguments.transport
    if named is not None:
        changes["server"] = {"transport": named}
    address = {key: getattr(arguments, key) for key in ("host", "port")}
    given = {key: value for key, value in address.items() if value is not None}
    if given:
        transport = named or _table(raw, "server").get("transport", _STDIO)
        if transport == _STDIO:
            raise ConfigurationError(
                "--host and --port are for http.", hint="Add --transport http."
            )
        changes[transport] = given  # a transport and its section have the same name
    return changes


def _table(raw: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return a table of the file; empty if it is missing."""
    found = raw.get(key, {})
    return found if isinstance(found, dict) else {}
