"""What a module of each kind is started with; everything unfit is refused here, before anything is
spawned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from roboneuron.config import Config, ModuleSettings
from roboneuron.errors import (
    ConfigurationError,
    InternalError,
    InvalidInputError,
    MissingDependencyError,
    PluginError,
    RoboNeuronError,
)
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES
from roboneuron.plugins.loading import load_options
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.server.tool import Arguments
from roboneuron.supervisor.slot import Selection

Choose = Callable[[ModuleKind, Config, Registry, Arguments | None, str], Selection]
"""Selects what a client asks for; called with kind, configuration, plugins, request and role;
raises as `select`.
"""


def select(kind: ModuleKind, config: Config, registry: Registry) -> Selection:
    """What is configured, checked.

    Raises:
        RoboNeuronError: as `KindEntry.plan` and `Plan.checked`.
        ConfigurationError: unknown or unusable options.
    """
    plan = KIND_ENTRIES[kind].plan(config, registry).checked(registry)
    settings = ModuleSettings(kind=kind, node_name=kind, config=plan.config)
    selection = Selection(settings=settings, names=plan.names, plan=plan)
    python = selection.python
    _check_options(plan.spec, plan.options, python, f"plugins.{plan.plugin}")
    for part in plan.others:
        _check_options(part, plan.config.options(part.name), python)
    return selection


def choose_configured(
    kind: ModuleKind, config: Config, registry: Registry, request: Arguments | None, role: str
) -> Selection:
    """What is configured, whatever the role."""
    if request is not None:
        raise InternalError(
            f"This server cannot read the {type(request).__name__} that a client sent for {kind}."
        )
    return select(kind, config, registry)


def _check_options(
    spec: Spec | DriverSpec,
    options: Mapping[str, Any],
    python: str | None,
    section: str | None = None,
) -> None:
    """Validate options here when the plugin can be imported here; a module with its own environment
    does it itself.
    """
    absent = () if python is None else (MissingDependencyError,)
    with suppress(*absent):
        load_options(spec, options, section=section)


def check_configuration(config: Config, registry: Registry) -> None:
    """Refuse a configuration that names what is not installed or sets what is unknown, before the
    server starts.

    Raises:
        ConfigurationError, PlanningError: as `select`; all that is wrong.
    """
    checks: list[Callable[[], None]] = [
        partial(_check_kind, kind, config, registry)
        for kind in KIND_ENTRIES
        if getattr(config, kind) is not None
    ]
    checks += [
        partial(_check_section, name, options, registry) for name, options in config.plugins.items()
    ]
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


def _check_kind(kind: ModuleKind, config: Config, registry: Registry) -> None:
    try:
        select(kind, config, registry)
    except InvalidInputError as error:  # a checkpoint may be named later, by the agent
        if error.path != "checkpoint":
            raise ConfigurationError(error.message, hint=error.hint) from error


def _check_section(name: str, options: Mapping[str, object], registry: Registry) -> None:
    """Refuse `[plugins.<name>]` of what does not exist, with unknown options, or with values that
    no plugin of that name takes.

    Options that are missing are no error: an agent may give them, or never choose that plugin.
    """
    registry.check_name(f"[plugins.{name}]", name)
    refused: list[ConfigurationError] = []
    for spec in registry.readers_of(name):
        try:
            load_options(spec, options, section=f"plugins.{name}", is_partial=True)
        except ConfigurationError as error:
            refused.append(error)
        except (MissingDependencyError, PluginError):
            return  # not to be judged here; told where it is chosen
        else:
            return
    if refused:
        raise refused[0]
