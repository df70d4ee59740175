"""Options of the driver `lerobot`."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from roboneuron import AgentMaySet, ConfigurationOnly


class MotorOption(BaseModel):
    """Which joint a motor moves, where names or units are not the usual ones.

    Usual are: the motor's name is the joint's, the unit is the one that LeRobot says its motor has
    (without a word of it degrees, and for a gripper 0 closed .. 100 open).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    joint: str | None = Field(
        default=None, description="Joint of the profile; the one of the motor's name without it."
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
        description="Joint position where the motor tells 0 [degrees]; not for percent.",
    )


class LerobotDriverOptions(BaseModel):
    """Options of the driver `lerobot`, which runs in lerobot's environment."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    motor_prefix: ClassVar[str] = ""
    """What the names of motors have before those of their joints."""

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="so101_follower", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="so101", description="LeRobot's `--robot.id`, by which calibrations are called."
    )
    port: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="LeRobot's `--robot.port`; empty where the robot has none."
    )
    calibration_dir: Annotated[str, ConfigurationOnly()] = Field(
        default="", description="Where calibrations are; empty for LeRobot's own place."
    )
    settings: Annotated[dict[str, str | int | float | bool], ConfigurationOnly()] = Field(
        default_factory=dict, description="Further settings of LeRobot's robot, by their names."
    )
    motors: Annotated[dict[str, MotorOption], AgentMaySet()] = Field(
        default_factory=dict, description="Motors that are not as usual, by name."
    )
    max_relative_target: float | None = Field(
        default=30.0,
        gt=0,
        description="How far a goal may be from where a motor is measured [its unit], as LeRobot's "
        "own setting of that name, beside our limits.",
    )
    rate_hz: float = Field(
        default=50.0, ge=5.0, le=200.0, description="Readings and goals per second."
    )
    silence_s: float = Field(
        default=0.5,
        gt=0,
        le=2.0,
        description="A bus that is silent this long is a fault [s]; one lost answer costs 0.17 s.",
    )
    release_on_close: bool = Field(
        default=False, description="Switch the torque off at the end: the arm falls down."
    )


class KochOptions(LerobotDriverOptions):
    """Options of the driver `lerobot` of a Koch arm."""

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="koch_follower", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="koch", description="LeRobot's `--robot.id`, by which calibrations are called."
    )


class LekiwiOptions(LerobotDriverOptions):
    """Options of the driver `lerobot` of a LeKiwi."""

    motor_prefix: ClassVar[str] = "arm_"

    type: Annotated[str, ConfigurationOnly()] = Field(
        default="lekiwi", description="LeRobot's `--robot.type`."
    )
    id: Annotated[str, ConfigurationOnly()] = Field(
        default="lekiwi", description="LeRobot's `--robot.id`, by which calibrations are called."
    )
    base_timeout_s: float = Field(
        default=0.5,
        ge=0.05,
        le=5.0,
        description="The base brakes when no velocity command came for this long [s].",
    )
