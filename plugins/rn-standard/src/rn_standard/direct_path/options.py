"""The section `[direct_path]` of roboneuron.toml."""

from __future__ import annotations

from pydantic import Field

from roboneuron import Section
from roboneuron.feature import models


class DirectPathOptions(Section):
    """`[direct_path]`: settings of every direct call."""

    dry_run: bool = Field(
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
