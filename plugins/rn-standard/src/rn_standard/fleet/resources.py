"""Resources of all robots, each with the robot's name after the scheme:
roboneuron://left/status.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from roboneuron import Resource

if TYPE_CHECKING:
    from roboneuron.feature import Application


def uri_of(robot: str, uri: str) -> str:
    """URI of a robot's resource in a server of several robots."""
    scheme, _, rest = uri.partition("://")
    return f"{scheme}://{robot}/{rest}"


def resources_of(robots: Mapping[str, Application]) -> dict[str, Resource]:
    """The resources of all robots by URI."""
    found = [
        replace(
            resource,
            uri=uri_of(name, resource.uri),
            name=f"{name}: {resource.name}",
            title=f"{name}: {resource.title}",
        )
        for name, robot in robots.items()
        for resource in robot.resources.values()
    ]
    return {resource.uri: resource for resource in found}
