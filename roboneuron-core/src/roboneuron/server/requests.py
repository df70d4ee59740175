"""Requests to start a module: arguments of the start tools, and what the closed loop selects a configuration from."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from roboneuron.server.tool import Arguments

MAX_INSTRUCTION_LENGTH = 1000
"""The inference module refuses longer ones."""

Options = Annotated[
    dict[str, Any],
    Field(
        default_factory=dict,
        description="Options of the plugin, laid over [plugins.<name>] of the configuration; what names hosts, files, "
        "devices or commands is for the configuration only.",
    ),
]


class StartRobot(Arguments):
    """Arguments of start_robot."""

    robot: str | None = Field(default=None, description="Which robot; the configured one when omitted.")
    driver: str | None = Field(
        default=None, description="How it is moved, see list_robots; the configured driver when omitted."
    )
    options: Options


class StartPerception(Arguments):
    """Arguments of start_perception."""

    source: str | None = Field(default=None, description="Where images come from; the configured one when omitted.")
    cameras: list[str] = Field(
        default_factory=list, description="Cameras of the robot to serve; all of them when omitted."
    )
    options: Options


class StartControl(Arguments):
    """Arguments of start_control."""

    controller: str | None = Field(
        default=None, description="What turns actions into joint commands; the configured one when omitted."
    )
    options: Options


class StartInference(Arguments):
    """Arguments of start_inference."""

    backend: str | None = Field(default=None, description="Which policy; the configured one when omitted.")
    checkpoint: str | None = Field(
        default=None,
        min_length=1,
        description="Directory of the model's files, for backends that need one; one that the configuration names or "
        "that lies in its checkpoint_roots.",
    )
    runtime: str | None = Field(
        default=None, description="Engine that executes the model; the backend's own default when omitted."
    )
    acceleration: str | None = Field(default=None, description="Acceleration preset; none when omitted.")
    instruction: str | None = Field(
        default=None,
        max_length=MAX_INSTRUCTION_LENGTH,
        description='What to do, for instance "pick up the red cube"; can be given later with set_instruction.',
    )
    cameras: dict[str, str] | None = Field(
        default=None, description="Camera name by role of the backend; the robot's own roles when omitted."
    )
    options: Options
