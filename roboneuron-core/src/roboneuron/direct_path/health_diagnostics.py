"""Reports on /diagnostics about modules that cannot report themselves."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from roboneuron.supervisor.health import EXPLANATIONS, FAULTS, Health, ModuleView

if TYPE_CHECKING:
    from diagnostic_msgs.msg import DiagnosticArray

    from roboneuron.ros.link import RosLink


class HealthDiagnostics:
    """Publishes every change of a module's health on /diagnostics, for modules that are frozen or
    gone.
    """

    def __init__(self, link: Callable[[], RosLink]) -> None:
        self._link = link
        self._send: Callable[[DiagnosticArray], None] | None = None

    def publish(self, view: ModuleView, before: Health, health: Health) -> None:
        """Publish one change; a listener of `Events.health`."""
        if view.plan is None:
            return
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # heavy

        from roboneuron.ros import topics

        if self._send is None:
            self._send = self._link().advertise(DiagnosticArray, topics.DIAGNOSTICS)
        level: bytes = DiagnosticStatus.OK
        if health in FAULTS:
            level = (
                DiagnosticStatus.STALE if health in ("silent", "stuck") else DiagnosticStatus.ERROR
            )
        told = DiagnosticStatus(
            level=level,
            name=f"{view.plan.config.namespace}/supervisor/{view.kind}",
            message=EXPLANATIONS[health],
            hardware_id=str(os.getpid()),
            values=[KeyValue(key="health", value=health), KeyValue(key="before", value=before)],
        )
        message = DiagnosticArray(status=[told])
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(
            time.time_ns(), 1_000_000_000
        )
        self._send(message)
