"""The feature: read-only tools."""

from __future__ import annotations

from collections.abc import Sequence

from rn_standard.tools_inspect.camera import camera_tool
from rn_standard.tools_inspect.catalogue import catalogue_tools
from roboneuron import Feature, Host, Tool


class InspectionTools(Feature[None]):
    """Adds get_camera_image, and one list_* tool for each kind of plugin of the closed loop."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See Feature."""
        return [camera_tool(host), *catalogue_tools(host)]
