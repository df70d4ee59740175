"""Options that users may set for a simulated arm and its cameras."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from rn_simulation.cubes import DEFAULT_COLOURS, check_colours
from roboneuron import ConfigurationError


class SimulatedArmOptions(BaseModel):
    """Options of a simulated arm; a robot's own driver may have more."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seed: int = Field(
        default=0, ge=0, description="Where the cubes lie; the same seed gives the same scene."
    )
    colours: tuple[str, ...] = Field(
        default=DEFAULT_COLOURS,
        description="One cube each: red, green, blue, yellow, orange, purple.",
    )
    real_time_factor: float = Field(
        default=1.0, gt=0.0, le=10.0, description="Simulated seconds per second of wall time."
    )
    stepped: bool = Field(
        default=False,
        description="Time passes only while commands are carried out, so that an evaluation can "
        "be repeated; see `roboneuron eval agents --time`.",
    )
    state_rate_hz: float = Field(
        default=60.0,
        ge=1.0,
        le=240.0,
        description="Rate at which the simulation's state is published for the cameras [Hz].",
    )

    @field_validator("colours")
    @classmethod
    def _known_colours(cls, colours: tuple[str, ...]) -> tuple[str, ...]:
        try:
            return check_colours(colours)
        except ConfigurationError as error:
            raise ValueError(str(error)) from error


class SimulatedCamerasOptions(BaseModel):
    """Options of the cameras of a simulated arm."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rate_hz: float = Field(
        default=10.0, gt=0.0, le=60.0, description="Images per second of each camera."
    )
    width: int = Field(default=224, ge=32, le=1280, description="Image width [px].")
    height: int = Field(default=224, ge=32, le=960, description="Image height [px].")
    depth: bool = Field(
        default=False,
        description="Publish the depth of each image too, on camera/<name>/depth.",
    )
    displaced_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        default=(0.0, 0.0, 0.0),
        description="Where the cameras beside the table are, relative to their calibration, in the "
        "base frame [m].",
    )
