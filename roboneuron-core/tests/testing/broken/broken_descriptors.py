"""Targets and option models that break the rules of descriptors."""

from pydantic import BaseModel, ConfigDict, Field

not_callable = 3


class WrongArguments:
    def __init__(self): ...


class OpenOptions(BaseModel):
    gain: float = Field(default=1.0, description="gain")


class BareOptions(BaseModel):
    model_config = ConfigDict(extra="forbid")

    gain: float = 1.0
