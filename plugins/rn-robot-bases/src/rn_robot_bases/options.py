"""User options of a simulated base."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from rn_simulation.engine import EngineChoice


class SimulatedBaseOptions(BaseModel):
    """Options of the driver `simulated`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command_timeout_s: float = Field(
        default=0.5,
        ge=0.05,
        le=5.0,
        description="The base brakes after this long without a velocity command [s].",
    )
    odometry_rate_hz: float = Field(
        default=50.0, ge=1.0, le=120.0, description="How often odometry is published."
    )
    engine: EngineChoice = Field(
        default="auto",
        description="Physics engine; auto is PyBullet where it is installed, otherwise MuJoCo.",
    )
