"""Conversion of a tool's arguments to the configuration of a module; forbidden choices of a client
are refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from roboneuron.config.models import Config, Section
from roboneuron.modules.inference.planning import InferencePlan
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import KIND_ENTRIES, Plan
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, RuntimeSpec, Spec
from roboneuron.selection.named import with_model
from roboneuron.selection.options import selection_options
from roboneuron.selection.permission import check_addresses, check_may_load, check_may_set
from roboneuron.selection.requests import REQUESTS, StartChosenInference
from roboneuron.selection.sections import section_for
from roboneuron.server.tool import Arguments


def choose(
    kind: ModuleKind,
    config: Config,
    registry: Registry,
    request: Arguments,
    role: str = "",
) -> Plan:
    """Plan a client's request.

    Args:
        kind: kind of the module.
        config, registry: the configuration, and the installed plugins.
        request: an instance of the kind's model, see `REQUESTS`.
        role: role of the requesting client; "" may set no restricted option.

    Raises:
        InvalidInputError: a required name is missing, the robot has no such camera, or the
            instruction is blank.
        CheckpointError: the checkpoint's path does not exist, or the backend uses none.
        ConfigurationError: unknown or unusable names or options.
        PlanningError: the parts are incompatible with each other or the robot.
        RefusedError: options that only the configuration may set, or a checkpoint outside of the
            permitted folders.
    """
    told: dict[str, str] = {}
    if isinstance(request, StartChosenInference):
        config, request, told = with_model(config, registry, request)
    configured = _configured_names(kind, config)
    section = _section(kind, config, registry, request)
    update: dict[str, Section] = {kind: section}
    plan = KIND_ENTRIES[kind].plan(config.model_copy(update=update), registry)
    policy = plan.policy if isinstance(plan, InferencePlan) else None
    spec = plan.spec
    config = _merge(config, plan.plugin, spec, getattr(request, "options", {}), role)
    of_backend = (
        policy is not None and getattr(request, "runtime", None) is None and spec.name in configured
    )
    for part in (spec, *plan.others):
        is_default = of_backend and isinstance(part, RuntimeSpec)
        if not is_default and part.name not in configured:
            check_addresses(part, config.options(part.name))
    checkpoint = getattr(request, "checkpoint", None)
    if checkpoint is not None and policy is not None and policy.takes_checkpoint:
        check_may_load(config, checkpoint)
    plan = KIND_ENTRIES[kind].check(config.model_copy(update=update), registry)
    return replace(plan, names={**plan.names, **told}) if told else plan


def _configured_names(kind: ModuleKind, config: Config) -> set[str]:
    """Names of the configured plugins for a kind of module."""
    section = config.module_section(kind)
    fields = ("driver", "source", "controller", "backend", "runtime", "acceleration")
    return (
        set()
        if section is None
        else {getattr(section, name) for name in fields if name in type(section).model_fields}
    )


def _section(kind: ModuleKind, config: Config, registry: Registry, request: Arguments) -> Section:
    """The configured section updated with the request, see `section_for` for another plugin than
    the configured one.
    """
    entry = KIND_ENTRIES[kind]
    field = "name" if kind == "robot" else entry.noun
    section: Section | None = config.module_section(kind)
    named = {
        key: getattr(request, key)
        for key in REQUESTS[kind].model_fields
        if key not in ("options", "model", "host")
    }
    wanted = named.pop(entry.noun)
    if wanted is None:
        section = entry.configured(config, registry)
    if section is None or wanted not in (None, getattr(section, field)):
        section = section_for(entry.section, section, field, wanted)
    if kind == "perception":
        named["cameras"] = tuple(named["cameras"]) or None
    return section.model_copy(
        update={key: value for key, value in named.items() if value is not None}
    )


def _merge(
    config: Config, name: str, spec: Spec | DriverSpec, options: Mapping[str, object], role: str
) -> Config:
    """Merge a client's `options` into `[plugins.<name>]`, if the client may set them."""
    if not options:
        return config
    before = config.options(name)
    merged = {**before, **options}
    check_may_set(spec, name, before, merged, selection_options(config).agent_options, role)
    return config.model_copy(update={"plugins": {**config.plugins, name: merged}})
