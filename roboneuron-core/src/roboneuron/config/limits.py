"""`[limits]`: what may be sent to the arm."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from roboneuron.config.section import Point, Reaction, Section, Share


class ZoneConfig(Section):
    """One entry of `limits.zones` or `limits.obstacles`."""

    name: str = Field(min_length=1, max_length=64, description="named in reports")
    lower_m: Point = Field(description="corner [x, y, z] in the base frame")
    upper_m: Point = Field(description="opposite corner")


class LimitsConfig(Section):
    """`[limits]`: what may be sent to the arm, by actions or by joint commands; see docs/safety.md."""

    velocity_fraction: Share = Field(default=1.0, description="share of the joints' velocity limits in use")
    acceleration_fraction: Share = Field(default=1.0, description="share of their acceleration limits in use")
    max_step_m: Annotated[float, Field(gt=0, le=1)] = Field(
        default=0.1, description="farthest the TCP may go per action"
    )
    max_step_rad: Annotated[float, Field(gt=0, le=3)] = Field(
        default=0.5, description="farthest it may turn per action"
    )
    max_speed_m_s: Annotated[float, Field(gt=0, le=3)] = Field(default=0.5, description="fastest motion of the TCP")
    max_turn_rad_s: Annotated[float, Field(gt=0, le=10)] = Field(default=2.5, description="fastest turn of the TCP")
    workspace_lower_m: Point | None = Field(
        default=None, description="corner of the TCP's box in the base frame; the robot's own when not given"
    )
    workspace_upper_m: Point | None = Field(default=None, description="opposite corner")
    min_height_m: Annotated[float, Field(ge=-100, le=100)] | None = Field(
        default=None, description="lowest z of the TCP in the base frame"
    )
    zones: tuple[ZoneConfig, ...] = Field(
        default=(),
        strict=False,
        description="boxes that the TCP must not enter: tables of `name`, `lower_m`, `upper_m`",
    )
    min_singular_value: Annotated[float, Field(ge=0, le=1)] = Field(
        default=0.02, description="distance from a singularity: smallest singular value of the TCP's Jacobian"
    )
    collision: bool = Field(default=True, description="keep links away from each other and from obstacles")
    min_distance_m: Annotated[float, Field(ge=0, le=0.2)] | None = Field(
        default=None, description="least distance between links, and to obstacles; the robot's own when not given"
    )
    obstacles: tuple[ZoneConfig, ...] | None = Field(
        default=None,
        strict=False,
        description="boxes that no link may touch, as `zones`; the robot's own (its table) when not given",
    )
    on_position: Reaction = Field(default="hold", description="a joint's position limit")
    on_velocity: Reaction = Field(default="scale", description="a joint's velocity limit")
    on_acceleration: Reaction = Field(default="scale", description="a joint's acceleration limit")
    on_step: Reaction = Field(default="hold", description="max_step_m, max_step_rad")
    on_speed: Reaction = Field(default="scale", description="max_speed_m_s, max_turn_rad_s")
    on_workspace: Reaction = Field(default="hold", description="the workspace box")
    on_zone: Reaction = Field(default="hold", description="zones")
    on_height: Reaction = Field(default="hold", description="min_height_m")
    on_singularity: Reaction = Field(default="hold", description="min_singular_value")
    on_collision: Reaction = Field(default="hold", description="min_distance_m between links, and to obstacles")
