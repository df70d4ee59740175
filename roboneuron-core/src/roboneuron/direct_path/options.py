"""The section `[direct_path]` of roboneuron.toml."""

from __future__ import annotations

import logging

from pydantic import Field, model_validator

from roboneuron.config import models
from roboneuron.config.models import Section

log = logging.getLogger(__name__)


class DirectPathOptions(Section):
    """`[direct_path]`: settings of every direct call."""

    simulate: bool = Field(
        default=False, description="direct calls answer what would happen, nothing is sent"
    )
    max_duration_s: models.Seconds = Field(
        default=120.0, description="longest direct motion, sequence or goal"
    )
    transforms: str = Field(
        default="",
        max_length=200,
        description='such as "/tf": places in another frame than their endpoint\'s are moved into '
        "it; empty: refused",
    )
    transform_age_s: models.Seconds = Field(default=1.0, description="oldest transform for that")

    @model_validator(mode="before")
    @classmethod
    def _accept_old_name(cls, given: object) -> object:
        if not isinstance(given, dict) or "dry_run" not in given or "simulate" in given:
            return given
        log.warning("[direct_path] dry_run is called simulate now; 0.2 will refuse it.")
        return {"simulate" if key == "dry_run" else key: value for key, value in given.items()}
