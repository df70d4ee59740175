"""Options under `[sight]`."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class SightOptions(BaseModel):
    """`[sight]`: how objects are found in pictures."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    locator: str = Field(default="colours", description="the locator that finds objects")
    table_m: float = Field(
        default=0.0,
        ge=-2,
        le=2,
        description="height of the table top in the base frame [m]",
    )
