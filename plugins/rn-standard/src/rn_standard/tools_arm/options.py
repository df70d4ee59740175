"""Options of the arm tools."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field


class ArmToolsOptions(BaseModel):
    """`[tools_arm]`: the tools that move an arm."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    ee_speed_m_s: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.25, description="fastest end-effector move"
    )
    ee_turn_rad_s: Annotated[float, Field(gt=0, le=3)] = Field(
        default=1.0, description="fastest end-effector turn"
    )
