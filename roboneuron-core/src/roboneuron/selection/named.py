"""Models by name, on this machine or on one that serves policies."""

from __future__ import annotations

from collections.abc import Mapping

from roboneuron.config.models import Config, Section
from roboneuron.errors import InvalidInputError, RoboNeuronError
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.planning import KIND_ENTRIES
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec
from roboneuron.selection.options import (
    HostOptions,
    NamedModelOptions,
    named_hosts,
)
from roboneuron.selection.requests import StartChosenInference
from roboneuron.selection.sections import section_for

_PARTS = ("backend", "checkpoint", "runtime", "acceleration")
"""Fields set by a named model."""


def with_model(
    config: Config, registry: Registry, request: StartChosenInference
) -> tuple[Config, StartChosenInference, dict[str, str]]:
    """Resolve the model of a request: return the configuration with it as the configured inference,
    the rest of the request, and the names of the choice; all unchanged if the request names no
    model.

    Raises:
        InvalidInputError: the model or machine is unknown, or the request also sets a part of the
            model.
    """
    name = request.model
    if name is None:
        if request.host is not None:
            raise InvalidInputError(
                "A machine is named for a `model` of the configuration; name that too.", path="host"
            )
        return config, request, {}
    models = NamedModelOptions.all_of(config)
    model = models.get(name)
    if model is None:
        listed = ", ".join(models) or "none; a person adds them as [models.<name>]"
        raise InvalidInputError(
            f"There is no model {name[:80]!r}.",
            hint=f"The configuration has: {listed}.",
            path="model",
        )
    for part in _PARTS:
        if getattr(request, part) is not None:
            raise InvalidInputError(
                f"The model {name!r} names its {part} itself; leave it out.", path=part
            )
    chosen = request.host or model.host
    told = {"model": name}
    backend: str
    options: Mapping[str, object]
    parts: dict[str, str | None]
    if chosen is None:
        parts = {
            "checkpoint": model.checkpoint,
            "runtime": model.runtime,
            "acceleration": model.preset,
        }
        profile = {} if model.profile is None else {"profile": model.profile}
        backend, options = model.backend, {**profile, **model.options}
    else:
        host = _host(config, chosen)
        told["host"] = chosen
        parts = dict.fromkeys(("checkpoint", "runtime", "acceleration"))
        backend, options = host.backend, _remote_options(config, registry, host, name, model)
    if model.fallback is not None:
        parts["fallback"] = model.fallback
    section: Section | None = config.inference
    if config.inference is None or config.inference.backend != backend:
        section = section_for(KIND_ENTRIES["inference"].section, section, "backend", backend)
    assert section is not None
    plugins = {**config.plugins, backend: {**config.options(backend), **options}}
    update = {"inference": section.model_copy(update=parts), "plugins": plugins}
    rest = request.model_copy(update={"model": None, "host": None})
    return config.model_copy(update=update), rest, told


def _host(config: Config, name: str) -> HostOptions:
    hosts = named_hosts(config)
    if name not in hosts:
        listed = ", ".join(hosts) or "none; a person adds them as [hosts.<name>]"
        raise InvalidInputError(
            f"There is no machine {name[:80]!r}.",
            hint=f"The configuration has: {listed}.",
            path="host",
        )
    return hosts[name]


def _remote_options(
    config: Config, registry: Registry, host: HostOptions, name: str, model: NamedModelOptions
) -> Mapping[str, object]:
    """Options of the backend `shared` for a model of another machine."""
    told = {**host.options, "address": host.address, "model": name}
    try:
        spec = registry.get(BackendSpec, model.backend, elsewhere=True)
        if spec.space is None or "space" in told:
            return told
        options: dict[str, object] = {**config.options(model.backend), **model.options}
        if model.checkpoint is not None:
            options["checkpoint"] = model.checkpoint
        space = SpaceAgreement.of(registry, spec, options, config.robot.name, None).declared
    except RoboNeuronError:
        # installed, or with its files, on the other machine only: an answer in another space is
        # refused
        return told
    channels = tuple(space.keys)
    return {**told, "space": {"kind": space.kind, "rate_hz": space.rate_hz, "channels": channels}}
