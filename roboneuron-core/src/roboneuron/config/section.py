"""A table of roboneuron.toml, and the types of values that several tables have."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
CameraName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
Namespace = Annotated[
    str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*(/[a-zA-Z][a-zA-Z0-9_]*)*$", max_length=128)
]
Seconds = Annotated[float, Field(gt=0, le=3600)]
Share = Annotated[float, Field(gt=0, le=1)]
Point = Annotated[list[Annotated[float, Field(ge=-100, le=100)]], Field(min_length=3, max_length=3)]


class Section(BaseModel):
    """A table of roboneuron.toml: no unknown keys, no conversions, no changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
