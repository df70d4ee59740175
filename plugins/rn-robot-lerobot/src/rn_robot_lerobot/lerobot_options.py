"""Options of the driver `lerobot`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from roboneuron import AgentMaySet, ConfigurationOnly


class MotorOption(BaseModel):
    """Joint and unit of a motor, if they are not the defaults.

    Defaults: the joint with the motor's name, and the unit that LeRobot reports for its motor
    (without a report degrees, and for a gripper 0 closed .. 100 open).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    joint: str | None = Field(
        default=None, description="Joint of the profile; default: the motor's name."
    )
    unit: Literal["degrees", "radians", "percent", "range"] | None = Field(
        default=None,
        description="degrees; radians; percent: 0..100 of a gripper's opening; range: -100..100 "
        "of the calibrated range.",
    )
    inverted: bool = Field(default=False, description="The motor turns the other way.")
    offset_deg: float = Field(
        default=0.0,
        ge=-360,
        le=360,
        description="Joint position at the motor's 0 [degrees]; not for percent.",
    )


class LerobotDriverOptions(BaseModel):
    """Options of the driver `lerobot`, which runs in lerobot's environment."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    motor_prefix: ClassVar[str] = ""
    """Prefix of the motors' names before the joints' names."""

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="so101_follower", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="so101", description="LeRobot's `--robot.id`, which names the calibration."
    )
    port: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="LeRobot's `--robot.port`; empty if the robot has none."
    )
    calibration_dir: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="Folder of the calibrations; empty for LeRobot's own."
    )
    settings: Annotated[dict[str, str | int | float | bool], ConfigurationOnly()] = Field(
        default_factory=dict, description="Further settings of LeRobot's robot, by name."
    )
    motors: Annotated[dict[str, MotorOption], AgentMaySet()] = Field(
        default_factory=dict, description="Motors with another joint or unit than usual, by name."
    )
    max_relative_target: float | None = Field(
        default=30.0,
        gt=0,
        description="Largest distance of a goal from the motor's measured position [its unit], "
        "like LeRobot's setting of that name, in addition to the profile's limits.",
    )
    rate_hz: float = Field(
        default=50.0, ge=5.0, le=200.0, description="Readings and goals per second."
    )
    silence_s: float = Field(
        default=0.5,
        gt=0,
        le=2.0,
        description="Silence of the bus that counts as a fault [s]; one lost answer costs 0.17 s.",
    )
    release_on_close: bool = Field(
        default=False, description="Switch the torque off on close: the arm falls down."
    )


class KochOptions(LerobotDriverOptions):
    """Options of the driver `lerobot` of a Koch arm."""

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="koch_follower", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="koch", description="LeRobot's `--robot.id`, which names the calibration."
    )


class LekiwiOptions(LerobotDriverOptions):
    """Options of the driver `lerobot` of a LeKiwi."""

    motor_prefix: ClassVar[str] = "arm_"

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="lekiwi", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="lekiwi", description="LeRobot's `--robot.id`, which names the calibration."
    )
    base_timeout_s: float = Field(
        default=0.5,
        ge=0.05,
        le=5.0,
        description="The base brakes after this long without a velocity command [s].",
    )
