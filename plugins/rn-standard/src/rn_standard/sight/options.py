"""Options under `[sight]`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class SightOptions(BaseModel):
    """`[sight]`: how objects are found in pictures."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    locator: str = Field(default="colours", description="the locator that finds objects")
