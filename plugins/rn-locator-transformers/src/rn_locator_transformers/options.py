"""Options of the locator `transformers`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from roboneuron import ConfigurationOnly

_Label = Annotated[str, Field(min_length=1, max_length=60)]


class TransformersLocatorOptions(BaseModel):
    """Options of the locator `transformers`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    checkpoint: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        description="Folder with config.json, model.safetensors, tokenizer and processor files.",
    )
    labels: tuple[_Label, ...] = Field(
        default=(), max_length=16, description="What to look for unless a call names it."
    )
    least_score: float = Field(default=0.3, ge=0, le=1, description="Less sure ones are left out.")
    most_boxes: int = Field(
        default=32, ge=1, le=128, description="The surest so many of a picture are kept."
    )
    device: str = Field(
        default="cpu", pattern=r"^(cpu|cuda(:\d+)?)$", description="Where the model runs."
    )
    usual_m: float = Field(
        default=0.05, gt=0, le=1, description="Size of what has a box without extent [m]."
    )
