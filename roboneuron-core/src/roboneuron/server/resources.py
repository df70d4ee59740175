"""What the agent sees of the server: get_status, and the same as an MCP resource beside those of
features.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from mcp import types
from mcp.shared.exceptions import MCPError

from roboneuron import __version__
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.results import ModuleStatus, StatusResult
from roboneuron.server.tool import CallContext, NoArguments, Resource, Tool


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
    cause = loop.emergency_stop.cause()
    return StatusResult(
        robot=loop.robot_facts,
        modules=[ModuleStatus.of(view) for view in loop.modules.views()],
        emergency_stop=loop.emergency_stop.is_latched(),
        **({"emergency_stop_cause": cause} if cause else {}),
        namespace=loop.config.namespace,
        tightened_limits=_tightened(loop),
        uptime_s=round(time.monotonic() - started_s, 1),
        pid=os.getpid(),
        versions=versions(),
        log_directory=str(loop.modules.log_directory),
    )


def _tightened(loop: ClosedLoop) -> dict[str, object]:
    """By key, the limits that are tighter than those of the configuration."""
    base, now = (limits.model_dump(mode="json") for limits in (loop.base.limits, loop.limits))
    return {key: value for key, value in now.items() if value != base[key]}


def status_tool(loop: ClosedLoop, started_s: float) -> Tool[Any]:
    """get_status."""

    async def get_status(_: NoArguments, context: CallContext) -> StatusResult:
        return status(loop, started_s)

    return Tool(
        name="get_status",
        title="Status of everything",
        description=(
            "Which robot this is, real or simulated; state, rates and errors of each module; "
            "whether the emergency "
            "stop is latched, and by whom."
        ),
        arguments=NoArguments,
        result=StatusResult,
        handler=get_status,
        read_only=True,
        idempotent=True,
    )


STATUS_URI = "roboneuron://status"


class Resources:
    """Lists and reads them: the server's own, and those that features offer."""

    def __init__(
        self, loop: ClosedLoop, started_s: float, offered: Iterable[Resource] = ()
    ) -> None:
        own = Resource(
            uri=STATUS_URI,
            name="status",
            title="Status of everything",
            description="The answer of get_status.",
            read=lambda: status(loop, started_s).model_dump_json(indent=2, exclude_unset=True),
            mime_type="application/json",
        )
        self._offered: dict[str, Resource] = {}
        for resource in (own, *offered):
            self._offered.setdefault(resource.uri, resource)

    def listing(self) -> list[types.Resource]:
        """What `resources/list` answers."""
        return [
            types.Resource(
                name=r.name,
                title=r.title,
                uri=r.uri,
                description=r.description,
                mime_type=r.mime_type,
            )
            for r in self._offered.values()
        ]

    def read(self, uri: str) -> types.TextResourceContents:
        """What `resources/read` answers. Raises as `check`."""
        self.check(uri)
        found = self._offered[uri]
        return types.TextResourceContents(uri=uri, mime_type=found.mime_type, text=found.read())

    def check(self, uri: str) -> None:
        """Raises MCPError when there is no such resource."""
        if uri not in self._offered:
            known = ", ".join(self._offered)
            raise MCPError(
                types.INVALID_PARAMS, f"There is no resource {uri[:200]!r}; there are: {known}."
            )
