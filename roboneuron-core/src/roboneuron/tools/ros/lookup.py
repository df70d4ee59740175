"""Tool lookup_<name>: the transform between two frames, from an exposed topic of transforms."""

from __future__ import annotations

import math
import threading

from pydantic import Field

from roboneuron.direct_path.transforms import STATIC, find_transform
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest
from roboneuron.server.tool import CallContext, Result
from roboneuron.tools.ros.calls import RobotCall
from roboneuron.tools.ros.targets import Targets


class Lookup(RobotCall):
    """Arguments of a lookup tool."""

    target: str = Field(min_length=1, max_length=200, description="Target frame.")
    source: str = Field(min_length=1, max_length=200, description="Source frame.")
    max_age_s: float = Field(
        default=1.0, gt=0, le=3600, description="Oldest transform that is used [s]."
    )
    timeout_s: float = Field(default=2.0, gt=0, le=60, description="[s]")


class FoundTransform(Result):
    """The pose of the source frame in the target frame."""

    robot: str
    target: str
    source: str
    x_m: float
    y_m: float
    z_m: float
    quaternion_xyzw: list[float]
    yaw_rad: float = Field(description="rotation about the target's z axis")
    age_s: float = Field(description="of the oldest transform used; 0: all are static")
    frames: list[str] = Field(description="frames from the source to the target")


class LookingUp:
    """The handler of one lookup tool."""

    def __init__(self, host: Host, targets: Targets, tool: str) -> None:
        self._host = host
        self._targets = targets
        self._tool = tool

    async def __call__(self, arguments: Lookup, context: CallContext) -> FoundTransform:
        """Raises InvalidInputError, RefusedError, NotReadyError, ConfigurationError."""
        exposed = self._targets.of(arguments.robot)
        self._host.gate.check(GateRequest.of(context, self._tool, exposed, (), arguments.given()))
        halt = threading.Event()
        return await context.run(lambda _: self._find(exposed, arguments, halt), on_cancel=halt.set)

    def _find(
        self, exposed: ExposedEndpoint, arguments: Lookup, halt: threading.Event
    ) -> FoundTransform:
        target, source = (frame.removeprefix("/") for frame in (arguments.target, arguments.source))
        found = find_transform(
            self._host,
            exposed.topic.removesuffix(STATIC),
            target,
            source,
            max_age_s=arguments.max_age_s,
            timeout_s=arguments.timeout_s,
            halt=halt,
        )
        x_m, y_m, z_m = (round(float(value), 6) for value in found.translation_m)
        yaw_rad = math.atan2(found.rotation[1, 0], found.rotation[0, 0])
        return FoundTransform(
            robot=exposed.robot,
            target=target,
            source=source,
            x_m=x_m,
            y_m=y_m,
            z_m=z_m,
            quaternion_xyzw=[round(float(value), 6) for value in found.quaternion_xyzw],
            yaw_rad=round(yaw_rad, 6),
            age_s=round(found.age_s, 3),
            frames=list(found.frames),
        )
