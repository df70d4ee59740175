"""Options of the arm tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from roboneuron.config import models

__all__ = ["fastest"]
"""Names that other distributions may use."""

_Length = Annotated[float, Field(gt=0, le=1)]


class HandOptions(BaseModel):
    """`[tools_arm.hand]`: measures of a hand with two parallel fingers; by default the Franka
    Hand's. Source: its collision meshes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    gap_m: _Length = Field(default=0.08, description="between the open fingers")
    finger_width_m: _Length = Field(default=0.022, description="of a finger, across the closing")
    finger_depth_m: _Length = Field(default=0.026, description="of a finger, along the closing")
    tip_m: float = Field(default=0.009, ge=0, le=0.2, description="fingertips beyond the TCP")
    deep_m: _Length = Field(default=0.03, description="deepest grasp below an object's top")
    palm_above_m: _Length = Field(default=0.037, description="lower side of the palm over the TCP")
    palm_width_m: _Length = Field(default=0.21, description="of the palm, along the closing")
    palm_depth_m: _Length = Field(default=0.064, description="of the palm, across the closing")


class ArmToolsOptions(BaseModel):
    """`[tools_arm]`: the tools that move an arm."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    ee_speed_m_s: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.25, description="fastest end-effector move"
    )
    ee_turn_rad_s: Annotated[float, Field(gt=0, le=3)] = Field(
        default=1.0, description="fastest end-effector turn"
    )
    hand: HandOptions = Field(default_factory=HandOptions, description="measures of the hand")


def fastest(options: ArmToolsOptions, limits: models.LimitsConfig) -> tuple[float, float]:
    """Fastest translation [m/s] and rotation [rad/s]: from the options, or from the limits in force
    if these are lower.
    """
    return min(options.ee_speed_m_s, limits.max_speed_m_s), min(
        options.ee_turn_rad_s, limits.max_turn_rad_s
    )
