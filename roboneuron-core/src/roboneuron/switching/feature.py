"""The feature: tools that replace running modules."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Tool
from roboneuron.switching.tools import switch_tools


class SwitchingFeature(Feature[None]):
    """Adds switch_inference, switch_perception and switch_control."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        return switch_tools(host.loop)
