"""Options of the LIBERO suites, given as `--suite-option NAME=VALUE`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class LiberoOptions(BaseModel):
    """Options of the simulator. Only `step_limit` and `image_px` change the protocol."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    python: Path = Field(
        default=Path(".venv-libero/bin/python"),
        description="interpreter of the environment that has the simulator",
    )
    renderer: Literal["egl", "osmesa"] = Field(
        default="egl", description="how MuJoCo draws without a display"
    )
    image_px: int = Field(default=256, ge=64, le=1024, description="width and height of the images")
    step_limit: int | None = Field(
        default=None, ge=1, le=10_000, description="steps of an episode, instead of the protocol's"
    )
    answer_s: float = Field(
        default=300.0, gt=0, le=3600, description="an answer of the simulator takes no longer [s]"
    )
