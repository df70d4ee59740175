"""User options of the driver `fci`."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from roboneuron import ConfigurationOnly


class FciDriverOptions(BaseModel):
    """Options of the driver `fci`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    host: Annotated[str, ConfigurationOnly()] = Field(
        description="Address of the robot's control box, or 127.0.0.1 for franka-sim.", min_length=1
    )
    gripper: Annotated[bool, ConfigurationOnly()] = Field(
        default=True, description="Whether a Franka Hand is mounted."
    )
    realtime: Annotated[Literal["required", "ignored"], ConfigurationOnly()] = Field(
        default="required",
        description="required refuses a kernel without PREEMPT_RT, as libfranka does; ignored is "
        "for simulators.",
    )
    dynamics_factor: Annotated[float, ConfigurationOnly()] = Field(
        default=0.3,
        gt=0.0,
        le=0.5,
        description="Share of velocity, acceleration and jerk that motions may use; a stop uses "
        "all of it.",
    )
    collision_torque_nm: Annotated[float, ConfigurationOnly()] = Field(
        default=20.0, gt=0.0, le=100.0, description="External joint torque that triggers a reflex."
    )
    collision_force_n: Annotated[float, ConfigurationOnly()] = Field(
        default=30.0,
        gt=0.0,
        le=200.0,
        description="External force at the end effector that triggers a reflex.",
    )
    load_kg: Annotated[float, ConfigurationOnly()] = Field(
        default=0.0, ge=0.0, le=3.0, description="Mass that the gripper always carries."
    )
    load_centre_m: Annotated[tuple[float, float, float], ConfigurationOnly()] = Field(
        default=(0.0, 0.0, 0.0), description="Its centre of mass in the flange's frame."
    )
    watchdog_s: Annotated[float, ConfigurationOnly()] = Field(
        default=0.5,
        ge=0.1,
        le=5.0,
        description="Stop if the robot module has not read the state for this long: it hangs.",
    )
    grasp_force_n: Annotated[float, ConfigurationOnly()] = Field(
        default=30.0, gt=0.0, le=70.0, description="Force with which the gripper closes."
    )
    gripper_speed_m_s: float = Field(
        default=0.1, gt=0.0, le=0.1, description="Speed of the gripper's width."
    )
    connect_timeout_s: float = Field(
        default=8.0, gt=0.0, le=20.0, description="Time for the control box to answer."
    )
    scene: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        pattern=r"^[0-9A-Za-z.\-]+:[0-9]+$",
        description="host:port where franka-sim serves its scene (rn_robot_fr3.fci.simulator); "
        "none for a real arm.",
    )
