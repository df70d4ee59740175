"""Targets and option models that break the rules of descriptors."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

not_callable = 3


class WrongArguments:
    def __init__(self): ...


class OpenOptions(BaseModel):
    gain: float = Field(default=1.0, description="gain")


class BareOptions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    gain: float = 1.0


class UnmarkedOptions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    weights: Path | None = Field(default=None, description="a file")


class UnmarkedTable(BaseModel):
    model_config = ConfigDict(extra="forbid")

    parts: dict[str, UnmarkedOptions] = Field(default_factory=dict, description="tables with files")
