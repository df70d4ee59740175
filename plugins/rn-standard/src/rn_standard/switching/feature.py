"""The feature: tools that replace running modules."""

from __future__ import annotations

from collections.abc import Sequence

from rn_standard.switching.tools import switch_tools
from roboneuron import Feature, Host, Tool


class SwitchingFeature(Feature[None]):
    """Adds switch_inference, switch_perception and switch_control."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See `Feature.tools`."""
        return switch_tools(host.loop)
