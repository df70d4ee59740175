"""What a configuration says, against what is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial

from roboneuron.config import Config
from roboneuron.errors import (
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    PluginError,
    RoboNeuronError,
    nearest,
)
from roboneuron.plugins.availability import install_command, known_names
from roboneuron.plugins.loading import load_options, load_options_model
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, RobotSpec, Spec
from roboneuron.server.module_kinds import KIND_ENTRIES, KindEntry
from roboneuron.server.selection import select


def check_configuration(config: Config, registry: Registry) -> None:
    """Refuse a configuration that names what is not installed or sets what is unknown, before the
    server starts.

    Raises:
        ConfigurationError, PlanningError: as `select` and `check_sections`; all
            that is wrong.
    """
    configured = [
        entry for entry in KIND_ENTRIES.values() if getattr(config, entry.kind) is not None
    ]
    checks: list[Callable[[], object]] = [
        partial(_check_kind, entry, config, registry) for entry in configured
    ]
    checks.append(partial(check_sections, config, registry))
    problems: dict[str, RoboNeuronError] = {}
    for check in checks:
        try:
            check()
        except RoboNeuronError as error:
            problems.setdefault(str(error), error)
    if len(problems) == 1:
        raise next(iter(problems.values()))
    if problems:
        raise ConfigurationError("\n".join(problems))


def _check_kind(entry: KindEntry, config: Config, registry: Registry) -> None:
    try:
        select(entry.kind, config, registry)
    except InvalidInputError as error:  # a checkpoint may be named later, by the agent
        if error.path != "checkpoint":
            raise ConfigurationError(error.message, hint=error.hint) from error


def check_sections(config: Config, registry: Registry) -> None:
    """Refuse options of what does not exist, unknown options, and values that no plugin of that
    name takes.

    Options that are missing are no error: an agent may give them, or never choose that plugin.

    Raises:
        ConfigurationError: says all that is wrong.
    """
    problems = []
    for name, options in config.plugins.items():
        problems += _problems_of_name(f"[plugins.{name}]", name, registry) or _problems_of_options(
            name, options, registry
        )
    for entry in config.server.agent_options:
        name, _, option = entry.partition(".")
        problems += _problems_of_name(
            f"agent_options {entry!r}", name, registry
        ) or _problems_of_entry(entry, name, option, registry)
    if problems:
        raise ConfigurationError("\n".join(problems))


def _problems_of_name(place: str, name: str, registry: Registry) -> list[str]:
    """Whether anything that is installed, or left out on purpose, has that name."""
    installed = {offer.spec.name for offer in registry.all_offers}
    if name in installed:
        return []
    ours = known_names()
    if name in ours:
        package = ours[name]
        if registry.not_loaded(package):
            return []
        return [f"{place}: {name!r} is not installed. Run: {install_command(package)}."]
    meant = nearest(name, {*installed, *ours})
    if not meant and registry.not_loaded():
        return []  # one of those that did not load may have that name
    return [
        f"{place}: nothing is called {name!r}. {meant or f'Installed are: {_listed(installed)}.'}"
    ]


def _problems_of_options(name: str, options: Mapping[str, object], registry: Registry) -> list[str]:
    """Why none of those that read this section can take it; empty when one can."""
    problems = []
    for spec in _readers(name, registry):
        try:
            load_options(spec, options, section=f"plugins.{name}", is_partial=True)
        except ConfigurationError as error:
            problems.append(str(error))
        except (MissingDependencyError, PluginError):
            return []  # not to be judged here; told where it is chosen
        else:
            return []
    return problems[:1]


def _problems_of_entry(entry: str, name: str, option: str, registry: Registry) -> list[str]:
    known: set[str] = set()
    for spec in _readers(name, registry):
        try:
            model = load_options_model(spec)
        except (MissingDependencyError, PluginError):
            return []
        if model is not None:
            known |= {field.alias or key for key, field in model.model_fields.items()}
    first = option.partition(".")[0]
    if first in known:
        return []
    meant = nearest(first, known, f"Its options: {_listed(known)}.")
    return [f"agent_options {entry!r}: {name!r} has no option {first!r}. {meant}"]


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"


def _readers(name: str, registry: Registry) -> Iterator[Spec | DriverSpec]:
    """Whatever reads `[plugins.<name>]`: offers of that name; of a robot, its drivers."""
    for offer in registry.all_offers:
        if offer.spec.name == name:
            yield from offer.spec.drivers if isinstance(offer.spec, RobotSpec) else (offer.spec,)
