"""The feature: read-only tools."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool
from roboneuron.tools.inspect.camera import camera_tool
from roboneuron.tools.inspect.catalogue import catalogue_tools


class InspectionTools(Feature[None]):
    """Adds get_camera_image, and one list_* tool for each kind of plugin of the closed loop."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See Feature."""
        return [camera_tool(host), *catalogue_tools(host)]
