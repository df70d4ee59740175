"""Source of a view beside a server: the ROS graph, the file of the emergency stop, and the
audit.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from rn_standard.console.diagnostics import DiagnosticsListener
from rn_standard.console.status import ReportedModule, ServerStatus
from rn_view.diagnostics.active_limits import limit_counts
from rn_view.diagnostics.event_list import AuditReader, EventList, add_record
from rn_view.diagnostics.module_health import HealthLines
from rn_view.sources.source import MODULE_KINDS, ModuleRow, PageState, module_row, robot_profile
from roboneuron import RobotProfile
from roboneuron.feature import AuditLog, Config, Registry, estop
from roboneuron.modules.arm_paths import UncheckedPaths

M = TypeVar("M")


class ViewNode:
    """The view's connections to the ROS graph, shared by all robots; made by `open`.

    Args:
        state_directory: of the server.
    """

    def __init__(self, state_directory: Path) -> None:
        self.diagnostics = DiagnosticsListener(state_directory)

    def open(self) -> None:
        """Join the ROS graph; raises as `roboneuron.ros.environment.prepare_environment`."""
        self.diagnostics.open()
        from roboneuron.command import RosLink  # heavy

        self.link = RosLink(f"roboneuron_view_{os.getpid()}")
        self.link.open()

    def close(self) -> None:
        """Leave the ROS graph."""
        self.link.close()
        self.diagnostics.close()


class AttachedSource:
    """Source of a view in a process of its own. It publishes nothing. Its stop is the file that
    every module polls.

    Args:
        config: of the server.
        registry: plugins installed here; must include the robot's.
        state_directory: of the server; with several robots the folder of this one.
        graph: connections to ROS; the caller opens and closes them.
        is_one_of_several: ignore the modules of other robots.
    """

    label = "attached"
    playback = None
    records = None

    def __init__(
        self,
        config: Config,
        registry: Registry,
        state_directory: Path,
        graph: ViewNode,
        *,
        is_one_of_several: bool = False,
    ) -> None:
        self._config = config
        self._registry = registry
        self._state_directory = state_directory
        self._graph = graph
        self._is_one_of_several = is_one_of_several
        self._audit = AuditReader(AuditLog.in_directory(state_directory).path)
        self._healths: dict[str, str] = {}
        self._unchecked = UncheckedPaths()
        self.shown_events = EventList()
        self._health_lines = HealthLines(self.shown_events)

    def now_s(self) -> float:
        """See Source."""
        return time.monotonic()

    def config(self) -> Config:
        """See Source."""
        return self._config

    def profile(self) -> RobotProfile:
        """See Source."""
        return robot_profile(self._config, self._registry)

    def snapshot(self) -> PageState:
        """See Source."""
        modules = {module.module: module for module in self._modules()}
        inference = modules.get("inference")
        robot, control = (
            modules[kind].metrics if kind in modules else {} for kind in ("robot", "control")
        )
        rows = tuple(
            _row(kind, modules.get(kind)) for kind in dict.fromkeys((*MODULE_KINDS, *modules))
        )
        for row in rows:
            before = self._healths.get(row.kind, "stopped")
            if row.health != before:
                self._health_lines.add(row.kind, row.health, before=before)
            self._healths[row.kind] = row.health
        stop = estop.EmergencyStopLatch.in_directory(self._state_directory)
        latch, reason = stop.read_state(), stop.still_reason()
        return PageState(
            modules=rows,
            is_latched=latch.latched,
            cause=latch.cause,
            why_still=() if reason is None else (reason,),
            instruction=inference.instruction if inference is not None else "",
            limit=control.get("limit", ""),
            limit_counts=limit_counts(control),
            unchecked=self._unchecked.why(self._config, self._registry, robot, control),
        )

    @property
    def release_command(self) -> str:
        """See Source."""
        return estop.EmergencyStopLatch.in_directory(self._state_directory).release_command

    def is_latched(self) -> bool:
        """See Source."""
        return estop.EmergencyStopLatch.in_directory(self._state_directory).is_latched()

    def poll(self) -> None:
        """See Source."""
        for record in self._audit.read_new():
            add_record(self.shown_events, record)

    def subscribe(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]:
        """See Source."""
        place = f"/{self._config.namespace}/{topic}"
        link = self._graph.link
        return link.follow(message_type, place, callback)

    def press_stop(self, who: str) -> str:
        """See Source. Writes the same file as `roboneuron estop`."""
        latch = estop.EmergencyStopLatch.in_directory(self._state_directory)
        audit = AuditLog.in_directory(self._state_directory)
        latch.latch(who=who, reason="pressed in the attached view", audit=audit)
        audit.close()
        return "Latched in the file that every module reads 50 times a second."

    def _modules(self) -> tuple[ReportedModule, ...]:
        """Modules of this robot. With one robot, the server may run another one than configured;
        then the modules of that robot are shown.
        """
        found = self._graph.diagnostics.read_status()
        own = [status for status in found if status.namespace == self._config.namespace]
        return (own or ([] if self._is_one_of_several else found) or [ServerStatus()])[0].modules


def _row(kind: str, module: ReportedModule | None) -> ModuleRow:
    if module is None:
        return ModuleRow(kind=kind, health="stopped")
    error = "" if module.error is None else module.error.message
    return module_row(kind, module.health, module, error=error)
