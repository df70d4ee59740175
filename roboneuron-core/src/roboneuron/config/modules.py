"""The sections of the four modules, and of the supervisor that runs them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron.config.section import CameraName, Name, Namespace, Seconds, Section


class RobotConfig(Section):
    """`[robot]`: which robot, moved how."""

    name: Name = Field(description="a robot offered by an installed plugin")
    driver: Name = Field(default="simulated", description="one of the robot's drivers")
    namespace: Namespace | None = Field(default=None, description="ROS namespace; the robot's name when not given")
    command_timeout_s: Seconds = Field(default=1.0, description="the driver holds when commands cease for this long")
    server_timeout_s: Seconds = Field(default=2.0, description="the driver holds when the server is frozen this long")
    state_rate_hz: Annotated[float, Field(ge=10, le=1000)] = Field(default=120.0, description="rate of joint_states")
    start_timeout_s: Seconds | None = Field(
        default=None, description="longest start, loading included; as in [supervisor] when not given"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class PerceptionConfig(Section):
    """`[perception]`: where images come from."""

    source: Name = Field(description="a perception source offered by an installed plugin")
    cameras: tuple[CameraName, ...] = Field(
        default=(), strict=False, description="names of the robot's cameras to serve; all of them when empty"
    )
    start_timeout_s: Seconds | None = Field(
        default=None, description="longest start, loading included; as in [supervisor] when not given"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class InferenceConfig(Section):
    """`[inference]`: which policy runs, and how."""

    backend: Name = Field(description="a backend offered by an installed plugin")
    checkpoint: str | None = Field(default=None, description="directory of the model's files")
    runtime: Name | None = Field(default=None, description="runtime; the backend's own default when not given")
    acceleration: Name | None = Field(default=None, description="acceleration preset; none when not given")
    instruction: str = Field(default="", description="what to do; can be set later")
    cameras: dict[str, CameraName] = Field(default_factory=dict, description="camera name by role of the backend")
    max_image_age_s: Seconds = Field(default=0.5, description="older images, joint states and poses are never acted on")
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.25, description="a warm switch to actions that differ more [m or rad] is refused"
    )
    start_timeout_s: Seconds | None = Field(
        default=None,
        description="longest start, loading included; when not given 900 with a checkpoint, else as in [supervisor]",
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class ControlConfig(Section):
    """`[control]`: how actions become joint commands."""

    controller: Name = Field(description="a controller offered by an installed plugin")
    action_timeout_s: Seconds = Field(default=0.5, description="older actions are dropped; then the arm holds")
    state_timeout_s: Seconds = Field(default=0.25, description="older joint states stop the arm")
    server_timeout_s: Seconds = Field(default=2.0, description="the arm holds when the server is frozen this long")
    command: Literal["joint_trajectory", "joint_state"] = Field(
        default="joint_trajectory", description="message type of the command topic"
    )
    switch_max_difference: Annotated[float, Field(gt=0)] = Field(
        default=0.05, description="a warm switch to commands or TCP poses that differ more [rad or m] is refused"
    )
    start_timeout_s: Seconds | None = Field(
        default=None, description="longest start, loading included; as in [supervisor] when not given"
    )
    python: str | None = Field(default=None, description="interpreter of the module's own environment")


class SupervisorConfig(Section):
    """`[supervisor]`: bounds on starting and stopping processes."""

    start_timeout_s: Seconds = Field(default=60.0, description="spawn until proof of readiness (loading included)")
    stop_timeout_s: Seconds = Field(default=5.0, description="deactivate and SIGTERM before SIGKILL")
    state_directory: str | None = Field(default=None, description="logs, latch and audit; XDG state when not given")
