"""The tool by which the agent sees the status of everything."""

from __future__ import annotations

import os
import platform
import time
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from roboneuron import __version__
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import StatusResult, module_status
from roboneuron.server.tool import CallContext, NoArguments, Tool


@cache
def versions() -> dict[str, str]:
    """Versions of what matters when something is reported."""
    found = {"roboneuron": __version__, "python": platform.python_version()}
    for package in ("mcp", "ros-jazzy-rclpy"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed as a package"
    return found


def status(loop: ClosedLoop, started_s: float) -> StatusResult:
    """The status of everything, `started_s` being the monotonic time of the server's start."""
    return StatusResult(
        modules=[module_status(view) for view in loop.supervisor.views()],
        emergency_stop=loop.emergency_stop.is_latched(),
        emergency_stop_cause=loop.emergency_stop.cause(),
        namespace=loop.config.namespace,
        uptime_s=round(time.monotonic() - started_s, 1),
        pid=os.getpid(),
        versions=versions(),
        log_directory=str(loop.supervisor.log_directory),
    )


def observing_tools(loop: ClosedLoop, started_s: float) -> list[Tool[Any]]:
    """get_status."""

    async def get_status(_: NoArguments, context: CallContext) -> StatusResult:
        return status(loop, started_s)

    return [
        Tool(
            name="get_status",
            title="Status of everything",
            description=(
                "State, process, rates, latencies, ages, drops and errors of each module; the emergency stop; versions."
            ),
            arguments=NoArguments,
            result=StatusResult,
            handler=get_status,
            read_only=True,
            idempotent=True,
        ),
    ]
