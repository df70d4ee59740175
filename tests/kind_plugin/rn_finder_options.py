"""Its section of the configuration."""

from pydantic import BaseModel, ConfigDict


class FinderOptions(BaseModel):
    """`[finder]`."""

    model_config = ConfigDict(extra="forbid")
    camera: str
