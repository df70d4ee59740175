"""Sections of roboneuron.toml that belong to features: checked against the options models of what is installed."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ValidationError

from roboneuron.config.explaining import explain, unknown_key
from roboneuron.config.whole import Config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.loading import load_options_model
from roboneuron.plugins.packages import install_command, package_of
from roboneuron.plugins.record import Status
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import FeatureSpec

STDIO = "stdio"
"""The transport of core."""
KEYS = frozenset(name for name, field in Config.model_fields.items() if not field.exclude)
"""Top-level keys of core."""


def check_sections(config: Config, registry: Registry, source: str = "roboneuron.toml") -> None:
    """Check the sections of all features, and that there is a feature for each.

    Raises:
        ConfigurationError: a key that nothing installed knows, a value that is not valid, or a section of a feature
            that cannot be used; says why.
    """
    owners = {key: offer for offer in registry.offers("feature") for key in _spec(offer.spec).keys}
    for key in config.sections:
        if key not in owners:
            package = package_of("feature", key.replace("_", "-"))
            if package is not None:
                raise ConfigurationError(
                    f"{source}: the section {key!r} belongs to a feature of {package}, which is not installed.",
                    hint=f"Run: {install_command(package)}.",
                )
            error = unknown_key(source, key, {*KEYS, *owners})
            raise ConfigurationError(
                error, hint="If it belongs to a feature, that is not installed: see `roboneuron plugins list`."
            )
        offer = owners[key]
        if offer.status is not Status.READY:
            raise ConfigurationError(
                f"{source}: the section {key!r} belongs to the feature {offer.spec.name!r} of {offer.distribution}, "
                f"which cannot be used ({offer.status}): {offer.reason}"
            )
    for spec in {owners[key].spec.name: _spec(owners[key].spec) for key in config.sections}.values():
        feature_options(spec, config, source)


def feature_options(spec: FeatureSpec, config: Config, source: str = "roboneuron.toml") -> BaseModel | None:
    """The options of a feature: its sections of the configuration, or their defaults.

    Raises:
        ConfigurationError: a key or value is not valid.
        PluginError, MissingDependencyError: the model cannot be loaded.
    """
    model = load_options_model(spec)
    if model is None:
        return None
    section = "" if spec.sections else spec.keys[0]
    raw: Any
    if spec.sections:
        raw = {key: config.sections[key] for key in spec.sections if key in config.sections}
    else:
        raw = config.sections.get(section, {})
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise explain(error, model, source, section) from error


def transport_feature(transport: str, registry: Registry) -> FeatureSpec:
    """The feature that serves a transport.

    Raises:
        ConfigurationError: there is none; says which package brings it.
    """
    served = {name: spec for spec in registry.specs("feature").values() for name in spec.transports}
    if transport in served:
        return served[transport]
    try:
        registry.get("feature", transport)  # by convention it is called as the transport: says why it is not there
    except ConfigurationError as error:
        raise ConfigurationError(f"transport = {transport!r}: {error.message}", hint=error.hint) from error
    choices = ", ".join([STDIO, *served])
    raise ConfigurationError(f"transport = {transport!r}: nothing serves it; choose one of: {choices}.")


def _spec(spec: object) -> FeatureSpec:
    assert isinstance(spec, FeatureSpec)
    return spec
