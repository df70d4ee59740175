"""From a tool's arguments to the configuration a module is started with; what a client may not name
is refused here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from rn_standard.inference.planning import InferencePlan
from rn_standard.selection.named import with_model
from rn_standard.selection.options import selection_options
from rn_standard.selection.permission import check_addresses, check_may_load, check_may_set
from rn_standard.selection.requests import REQUESTS, StartChosenInference
from roboneuron import Arguments, DriverSpec, RuntimeSpec, Section, Spec
from roboneuron.feature import (
    KIND_ENTRIES,
    Config,
    ModuleKind,
    Plan,
    Registry,
)


def choose(
    kind: ModuleKind,
    config: Config,
    registry: Registry,
    request: Arguments | None = None,
    role: str = "",
) -> Plan:
    """Check what a client asks for, or without a request what is configured.

    Args:
        kind: of the module.
        config, registry: the configuration, and the installed plugins.
        request: of the kind's model, see `REQUESTS`.
        role: of the client that made the request; "" may set nothing that is restricted.

    Raises:
        InvalidInputError: something needed is not named, the robot has no such camera, or the
            instruction is blank.
        CheckpointError: the checkpoint's path does not exist, or the backend takes none.
        ConfigurationError: unknown or unusable names or options.
        PlanningError: the parts do not fit together or the robot.
        RefusedError: options that only the configuration may set, or a checkpoint outside of what
            it allows.
    """
    chosen_by_agent = request is not None
    request = request or REQUESTS[kind]()
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
    if chosen_by_agent:
        of_backend = (
            policy is not None
            and getattr(request, "runtime", None) is None
            and spec.name in configured
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
    """Names of the plugins that the configuration chooses for a kind of module."""
    section: Section | None = getattr(config, kind)
    fields = ("driver", "source", "controller", "backend", "runtime", "acceleration")
    return (
        set()
        if section is None
        else {getattr(section, name) for name in fields if name in type(section).model_fields}
    )


def _section(kind: ModuleKind, config: Config, registry: Registry, request: Arguments) -> Section:
    """The configured section with what the request names; one of its own for another plugin than
    the configured.
    """
    entry = KIND_ENTRIES[kind]
    field = "name" if kind == "robot" else entry.noun
    section: Section | None = getattr(config, kind)
    named = {
        key: getattr(request, key)
        for key in REQUESTS[kind].model_fields
        if key not in ("options", "model", "host")
    }
    wanted = named.pop(entry.noun)
    if wanted is None:
        section = entry.configured(config, registry)
    if section is None or wanted not in (None, getattr(section, field)):
        section = entry.section.model_validate({field: wanted})
    if kind == "perception":
        named["cameras"] = tuple(named["cameras"]) or None
    return section.model_copy(
        update={key: value for key, value in named.items() if value is not None}
    )


def _merge(
    config: Config, name: str, spec: Spec | DriverSpec, options: Mapping[str, object], role: str
) -> Config:
    """The configuration with a client's `options` laid over `[plugins.<name>]`, where the client
    may set them.
    """
    if not options:
        return config
    before = config.options(name)
    merged = {**before, **options}
    check_may_set(spec, name, before, merged, selection_options(config).agent_options, role)
    return config.model_copy(update={"plugins": {**config.plugins, name: merged}})
