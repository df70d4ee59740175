"""The sections `[direct]`, `[[expose]]` and `[[discover]]`: endpoints that agents may use
directly.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron.config import models
from roboneuron.config.models import Section

EndpointName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,47}$")]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]


Corner = Annotated[
    list[Annotated[float, Field(ge=-1e6, le=1e6)]], Field(min_length=3, max_length=3)
]


class PlaceZone(Section):
    """One entry of `zones`."""

    name: str = Field(min_length=1, max_length=64, description="named in refusals")
    lower_m: Corner = Field(description="corner [x, y, z]")
    upper_m: Corner = Field(description="opposite corner")


class ExposeConfig(Section):
    """`[[expose]]`: a ROS interface that agents may use directly, or limits on one that the robot's
    profile exposes.
    """

    robot: models.Name | None = Field(
        default=None, description="whose it is; the configured robot when not given"
    )
    namespace: models.Namespace | None = Field(
        default=None,
        description="ROS namespace of that robot; by default its name with underscores",
    )
    name: EndpointName | None = Field(
        default=None,
        description="short noun in the tools' names; without it the robot's whole profile is "
        "exposed",
    )
    kind: Literal["publish", "read", "service", "action", "parameters"] | None = Field(
        default=None, description="what agents may do; as in the robot's profile when not given"
    )
    topic: str | None = Field(
        default=None,
        max_length=200,
        description="topic, service, action or node; absolute or in the namespace",
    )
    type: str | None = Field(
        default=None, description="package/msg/Name, package/srv/Name or package/action/Name"
    )
    summary: str = Field(default="", max_length=500, description="one line for the agent")
    parameters: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="of kind parameters: those that agents may use, besides those in bounds",
    )
    bounds: dict[str, Range] = Field(
        default_factory=dict, description="[lowest, highest] by field path"
    )
    frame: str = Field(
        default="", max_length=200, description="places that are sent have to be in this frame"
    )
    zones: tuple[PlaceZone, ...] = Field(
        default=(), strict=False, description="boxes in that frame that no place may be in"
    )
    rate_hz: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=None, description="most messages per second"
    )
    clamp: tuple[str, ...] = Field(
        default=(), strict=False, description="fields that are clamped instead of refused"
    )
    nonfinite: tuple[str, ...] = Field(
        default=(), strict=False, description="fields that may hold NaN and infinities"
    )
    stop_message: Literal["", "zero"] | dict[str, object] = Field(
        default="", description='ends every motion: "zero", or the message itself'
    )
    repeat_hz: Annotated[float, Field(ge=0, le=100)] | None = Field(
        default=None, description="a lasting value is sent again this often"
    )
    require_subscriber: bool = Field(
        default=True, description="without a subscriber a message is an error"
    )
    moves: bool = Field(
        default=True, description="false: it moves nothing and may be used while a policy acts"
    )


class DiscoverConfig(Section):
    """`[[discover]]`: interfaces of the live ROS graph that agents may use without a separate entry
    for each.
    """

    pattern: str = Field(
        min_length=2, max_length=200, pattern=r"^/[A-Za-z0-9_/*?]+$", description="such as /arm/*"
    )
    kinds: tuple[Literal["read", "publish", "service", "action"], ...] = Field(
        default=("read",), strict=False, description="what agents may do with what matches"
    )
    robot: models.Name | None = Field(
        default=None, description="whose it is; the configured robot when not given"
    )
    rate_hz: Annotated[float, Field(gt=0, le=1000)] | None = Field(
        default=10.0, description="most messages per second of each endpoint"
    )
    limits: dict[str, dict[str, Range]] = Field(
        default_factory=dict,
        description='[lowest, highest] by field path, by type; `"*"` is every other number of the '
        "type",
    )
    unlimited: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="types whose numbers may be sent though nothing limits them",
    )
    period_s: Annotated[float, Field(ge=0.1, le=60)] = Field(
        default=1.0, description="how often it is looked at"
    )
    most: Annotated[int, Field(ge=1, le=2000)] = Field(
        default=200, description="most endpoints of this pattern"
    )


class DirectConfig(Section):
    """`[direct]`: the tools derived from ROS interfaces."""

    profile: bool = Field(default=True, description="expose the endpoints of the robot's profile")
    listed_tools: Annotated[int, Field(ge=0, le=10000)] = Field(
        default=100,
        description="more derived tools than this are reached by find_tools and call_tool",
    )
    expose_without_token: bool = Field(
        default=False,
        description="expose_endpoint is for clients without a token too: agents on stdio and "
        "loopback",
    )


class RosToolsOptions(Section):
    """All sections of the feature."""

    direct: DirectConfig = Field(default=DirectConfig(), description="see `[direct]`")
    expose: tuple[ExposeConfig, ...] = Field(
        default=(), strict=False, description="see `[[expose]]`"
    )
    discover: tuple[DiscoverConfig, ...] = Field(
        default=(), strict=False, description="see `[[discover]]`"
    )
