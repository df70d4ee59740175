"""Options under `[plugins.servo]`: the table, the cubes, and the motion."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from rn_backend_servo.plugin import MAX_ROWS


class ServoOptions(BaseModel):
    """Options of the backend `servo`; lengths along z are heights in the robot's base frame."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    table_m: float = Field(
        default=0.0, ge=-2, le=2, description="Height of the table top in the base frame [m]."
    )
    edge_m: float = Field(
        default=0.044, gt=0.01, le=0.2, description="Usual edge of the cubes [m]."
    )
    edge_spread_m: float = Field(
        default=0.004, gt=0, le=0.05, description="Typical deviation from that edge [m]."
    )
    hover_m: float = Field(
        default=0.12, gt=0, le=0.5, description="TCP above the table before the descent [m]."
    )
    grasp_m: float = Field(
        default=0.02, gt=0, le=0.2, description="TCP above the table when the gripper closes [m]."
    )
    lift_m: float = Field(
        default=0.20, ge=0.03, le=0.5, description="Lift of the grasped cube [m]."
    )
    retreat_m: float = Field(
        default=0.30,
        gt=0,
        le=0.6,
        description="TCP above the table at which the hand does not hide cubes [m].",
    )
    max_step_m: float = Field(
        default=0.03, gt=0, le=0.05, description="Longest translation per action [m]."
    )
    max_turn_rad: float = Field(
        default=0.2, gt=0, le=0.3, description="Largest rotation per action [rad]."
    )
    gain: float = Field(
        default=0.5,
        gt=0,
        le=1,
        description="Fraction of the remaining error that one action corrects.",
    )
    step_s: float = Field(default=0.1, gt=0, le=1, description="Time between two actions [s].")
    rows: int = Field(
        default=1,
        ge=1,
        le=MAX_ROWS,
        description="Actions per prediction; more keep the arm moving while it computes.",
    )
    max_attempts: int = Field(default=4, ge=1, le=20, description="Grasps tried before giving up.")
    holding_open: float = Field(
        default=0.15,
        gt=0,
        lt=1,
        description="Gripper opening above which the closed fingers hold an object.",
    )


class HandOverOptions(ServoOptions):
    """Options of the backend `servo-pair`; in addition the giver, the taker and the meeting
    point.
    """

    giver: str = Field(default="left", description="Name of the arm that picks the cube up.")
    max_turn_rad: float = Field(
        default=0.12, gt=0, le=0.3, description="Largest rotation per action [rad]."
    )
    taker: str = Field(default="right", description="Name of the arm that takes the cube.")
    meeting_m: tuple[float, float, float] = Field(
        default=(0.575, 0.0, 0.40), description="Meeting point in the base frame [m]."
    )
    apart_m: float = Field(
        default=0.14, gt=0.08, le=0.4, description="Distance of the arms from it otherwise [m]."
    )
