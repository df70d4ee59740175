"""Options of the presets."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field


class PresetConfig(BaseModel):
    """Options of the presets with a fixed share."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    k: Annotated[int, Field(ge=1)] = 2
    """Layers that process all visual tokens; the attention of the last of them selects."""
    query: Literal["last", "actions"] = "last"
    """Rows whose attention selects: the last position (as published), or the mean over the action
    rows of OpenVLA-OFT.
    """


class FastVConfig(PresetConfig):
    """Options of `fastv`."""

    r: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]
    """Fraction of the visual tokens that is dropped."""
