"""Options under `[plugins.urdf]`: bounds of one step and tolerances of the solution."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class UrdfControllerOptions(BaseModel):
    """Bounds of one control step; everything beyond them is refused, never clipped."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    track: Literal["pose", "position"] = Field(
        default="pose",
        description="'pose' follows translation and rotation; 'position' lets the rotation go "
        "where it must, for arms "
        "with fewer than six joints.",
    )
    max_translation_m: float = Field(
        default=0.08, gt=0, description="Longest translation of one action [m]."
    )
    max_rotation_rad: float = Field(
        default=0.3, gt=0, description="Largest rotation of one action [rad]."
    )
    max_joint_step_rad: float = Field(
        default=0.3,
        gt=0,
        description="Farthest a revolute joint may go in one step [rad]; more is a jump.",
    )
    max_joint_step_m: float = Field(
        default=0.1,
        gt=0,
        description="Farthest a prismatic joint may go in one step [m]; more is a jump.",
    )
    velocity_fraction: float = Field(
        default=0.9,
        gt=0,
        le=1,
        description="Share of the joint velocity limits that a command may need on average.",
    )
    position_tolerance_m: float = Field(
        default=1e-4,
        gt=0,
        description="Largest distance of an accepted solution from its target [m].",
    )
    rotation_tolerance_rad: float = Field(
        default=1e-3,
        gt=0,
        description="Largest rotation between an accepted solution and its target [rad].",
    )
    limit_slack_rad: float = Field(
        default=0.01,
        ge=0,
        description="How far outside its limits a revolute joint may be measured [rad].",
    )
    limit_slack_m: float = Field(
        default=0.001,
        ge=0,
        description="How far outside its limits a prismatic joint may be measured [m].",
    )
    max_iterations: int = Field(
        default=40, ge=1, le=1000, description="Iterations of the solver before it gives up."
    )
