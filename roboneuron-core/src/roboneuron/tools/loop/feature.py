"""The feature: tools of the closed loop, and its status as a resource with change notifications."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.tool import Resource, Tool
from roboneuron.tools.loop.reset import reset_tool
from roboneuron.tools.loop.status import STATUS_URI, status_resource, status_tool
from roboneuron.tools.loop.tools import INSTRUCTION, start_tools


class LoopTools(Feature[None]):
    """start_* for each kind of module, set_instruction, get_status and reset_emergency_stop."""

    def tools(self, host: Host) -> Sequence[Tool]:
        """See Feature."""

        def changed(*_: object) -> None:
            host.events.resource.tell(STATUS_URI)

        if "inference" not in host.loop.forms:
            host.loop.accept([INSTRUCTION])
        host.events.health.listen(changed)
        host.events.fault.listen(changed)
        return [
            reset_tool(host.loop),
            status_tool(host),
            *start_tools(host.loop),
        ]

    def resources(self, host: Host) -> Sequence[Resource]:
        """See Feature."""
        return [status_resource(host)]
