"""The section `[view]` of roboneuron.toml."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from roboneuron import Section


class ViewOptions(Section):
    """`[view]`: the page in the browser."""

    enabled: bool = Field(default=False, description="serve the page; nothing listens without it")
    host: str = Field(
        default="127.0.0.1", min_length=1, max_length=253, description="address to listen on"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default=8780, description="port; 0: any free one"
    )
    image_hz: Annotated[float, Field(gt=0, le=60)] = Field(
        default=15.0, description="maximum image rate of each camera"
    )
    max_viewers: Annotated[int, Field(ge=1, le=64)] = Field(
        default=8, description="maximum number of pages at once"
    )
