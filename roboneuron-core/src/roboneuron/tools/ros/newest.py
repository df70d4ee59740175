"""Tools that return the newest message of a topic in plain units."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from pydantic import Field

from roboneuron.server.host import Host
from roboneuron.server.motion_gate import GateRequest
from roboneuron.server.tool import CallContext, Result
from roboneuron.tools.ros.calls import RobotCall
from roboneuron.tools.ros.reading import read_newest
from roboneuron.tools.ros.targets import Targets


class GetNewest(RobotCall):
    """Arguments of a tool for the newest message."""

    timeout_s: float = Field(default=5.0, gt=0, le=60, description="[s]")


A = TypeVar("A", bound=GetNewest)
R = TypeVar("R", bound=Result)


class GettingNewest(Generic[A, R]):
    """The handler of one tool.

    Args:
        host: provides the ROS node and the gate.
        targets: endpoints of the tool.
        tool: its name.
        tell: creates the result from the robot's name, the message, the arguments and the time
            since its arrival [s].
    """

    def __init__(
        self, host: Host, targets: Targets, tool: str, tell: Callable[[str, Any, A, float], R]
    ) -> None:
        self._host, self._targets, self._tool, self._tell = host, targets, tool, tell

    async def __call__(self, arguments: A, context: CallContext) -> R:
        """Raises InvalidInputError, RefusedError, NotReadyError, ConfigurationError."""
        exposed = self._targets.of(arguments.robot)
        self._host.gate.check(GateRequest.of(context, self._tool, exposed, (), arguments.given()))
        halt = threading.Event()

        def work() -> R:
            came_s, message = read_newest(self._host, exposed, arguments.timeout_s, halt)
            return self._tell(exposed.robot, message, arguments, time.monotonic() - came_s)

        return await context.run(lambda _: work(), on_cancel=halt.set)
