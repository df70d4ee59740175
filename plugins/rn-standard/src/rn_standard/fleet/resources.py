"""The resources of all robots, each with the robot's name behind the scheme:
roboneuron://left/status.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from mcp import types
from mcp.shared.exceptions import MCPError

from roboneuron.feature import Resources

if TYPE_CHECKING:
    from roboneuron.feature import Application


def uri_of(robot: str, uri: str) -> str:
    """The URI of a robot's resource in the server of several."""
    scheme, _, rest = uri.partition("://")
    return f"{scheme}://{robot}/{rest}"


class FleetResources(Resources):
    """Lists and reads them."""

    def __init__(self, robots: Mapping[str, Application]) -> None:
        self._offered = {}  # each robot has its own
        self._robots = robots

    def listing(self) -> list[types.Resource]:
        """What `resources/list` answers."""
        return [
            resource.model_copy(
                update={
                    "uri": uri_of(name, str(resource.uri)),
                    "name": f"{name}: {resource.name}",
                    "title": f"{name}: {resource.title}",
                }
            )
            for name, robot in self._robots.items()
            for resource in robot.resources.listing()
        ]

    def read(self, uri: str) -> types.TextResourceContents:
        """What `resources/read` answers. Raises as `check`."""
        robot, own = self._find(uri)
        return robot.resources.read(own).model_copy(update={"uri": uri})

    def check(self, uri: str) -> None:
        """Raises MCPError when there is no such resource."""
        robot, own = self._find(uri)
        robot.resources.check(own)

    def _find(self, uri: str) -> tuple[Application, str]:
        scheme, _, rest = uri.partition("://")
        name, _, own = rest.partition("/")
        if name not in self._robots:
            start = f"{scheme}://" if scheme.isalpha() else "roboneuron://"
            known = ", ".join(f"{start}{name}/..." for name in self._robots)
            raise MCPError(
                types.INVALID_PARAMS, f"There is no resource {uri[:200]!r}; there are: {known}."
            )
        return self._robots[name], f"{scheme}://{own}"
