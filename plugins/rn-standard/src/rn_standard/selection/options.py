"""Its section of roboneuron.toml: models by name."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from roboneuron import Section
from roboneuron.feature import Config
from roboneuron.feature import models as core_models


class ModelConfig(Section):
    """`[models.<name>]`: a policy that agents may choose by its name."""

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
    options: dict[str, Any] = Field(
        default_factory=dict, description="laid over the backend's own in [plugins]"
    )
    summary: str = Field(
        default="", description="what it is good for; agents read it in list_models"
    )


class SelectionSections(Section):
    """The sections of the feature."""

    models: dict[core_models.Name, ModelConfig] = Field(
        default_factory=dict, description="policies by the name agents choose by"
    )


def named_models(config: Config) -> dict[str, ModelConfig]:
    """The models of a configuration by name."""
    return SelectionSections(models=config.sections.get("models", {})).models
