"""Sections of the feature in roboneuron.toml: options that agents may set, and models by name."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import Field, field_validator

from roboneuron.config import models as core_models
from roboneuron.config.models import Config, Section

__all__ = ["NamedModelOptions"]
"""Names that other distributions may use."""


class NamedModelOptions(Section):
    """`[models.<name>]`: a policy that agents may choose by name."""

    backend: core_models.Name = Field(description="a backend offered by an installed plugin")
    checkpoint: str | None = Field(default=None, description="directory of the model's files")
    profile: str | None = Field(
        default=None, description="the backend's option `profile`: what the checkpoint expects"
    )
    runtime: core_models.Name | None = Field(
        default=None, description="runtime; the backend's own default when not given"
    )
    preset: core_models.Name | None = Field(
        default=None, description="acceleration preset; none when not given"
    )
    host: core_models.Name | None = Field(
        default=None, description="one of [hosts] that serves it by this name; else this machine"
    )
    fallback: core_models.Name | None = Field(
        default=None, description="a backend that acts while this one does not answer in time"
    )
    options: dict[str, object] = Field(
        default_factory=dict, description="laid over the backend's own in [plugins]"
    )
    summary: str = Field(
        default="", description="what it is good for; agents read it in list_models"
    )

    @classmethod
    def all_of(cls, config: Config) -> dict[str, NamedModelOptions]:
        """The models of a configuration by name."""
        return SelectionSections(models=config.sections.get("models", {})).models


class HostOptions(Section):
    """`[hosts.<name>]`: a machine that serves policies (`roboneuron policy serve`)."""

    address: str = Field(description="host:port; a name of `roboneuron link` too")
    backend: core_models.Name = Field(
        default="shared", description="the backend that asks that machine"
    )
    options: dict[str, object] = Field(
        default_factory=dict, description="laid over that backend's own in [plugins]"
    )

    @field_validator("address")
    @classmethod
    def _check_address(cls, value: str) -> str:
        if re.fullmatch(r"[^\s:/]{1,253}:\d{1,5}", value) is None:
            raise ValueError("expected host:port, such as gpu:7420")
        return value


class SelectionOptions(Section):
    """`[selection]`: options that agents may set in addition to the configured ones."""

    checkpoint_roots: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="folders whose checkpoints agents may name, besides those that this "
        "configuration names",
    )
    agent_options: tuple[Annotated[str, Field(pattern=r"^[a-z0-9-]+(\.[^.]+)+$")], ...] = Field(
        default=(),
        strict=False,
        description="options for the configuration only that an admin may set all the same, such "
        'as "openpi.url"',
    )


class SelectionSections(Section):
    """The sections of the feature."""

    selection: SelectionOptions = Field(
        default=SelectionOptions(), description="what agents may set"
    )

    models: dict[core_models.Name, NamedModelOptions] = Field(
        default_factory=dict, description="policies by the name agents choose by"
    )

    hosts: dict[core_models.Name, HostOptions] = Field(
        default_factory=dict, description="machines that serve models, by name"
    )


def named_hosts(config: Config) -> dict[str, HostOptions]:
    """The machines of a configuration by name."""
    return SelectionSections(hosts=config.sections.get("hosts", {})).hosts


def selection_options(config: Config) -> SelectionOptions:
    """`[selection]` of a configuration."""
    return SelectionOptions.model_validate(config.sections.get("selection", {}))
