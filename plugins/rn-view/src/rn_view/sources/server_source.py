"""Source of a view in the server's process."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TypeVar

from rn_standard.ops.maintenance import MaintenanceFeature
from rn_view.diagnostics.active_limits import limit_counts
from rn_view.diagnostics.alarm_rules import AlarmRules
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.event_list import AuditReader, EventList, add_record
from rn_view.diagnostics.module_health import HealthLines
from rn_view.sources.records import RobotRecords
from rn_view.sources.source import (
    ModuleRow,
    PageState,
    chosen_plugin,
    module_row,
    robot_profile,
)
from rn_view.tasks.past_tasks import TASK_TOOL, PastTasks
from roboneuron import Host, RobotProfile
from roboneuron.feature import FAULTS, Config, Health, ModuleView
from roboneuron.tools.loop.results import ModuleStatus

M = TypeVar("M")
_SHOWN_VERDICTS = (
    "refused",
    "would_refuse",
    "scaled",
    "held",
    "latched",
    "restored",
    "reset",
    "lapsed",
)
"""Verdicts that become events. Allowed calls are in the list already, as tool calls."""


class ServerSource:
    """Source that reads the objects of the server in this process."""

    label = "live"
    playback = None

    def __init__(self, host: Host) -> None:
        self._host = host
        self._audit = AuditReader(host.audit.path)
        self.shown_events = EventList()
        self._health_lines = HealthLines(self.shown_events)
        self._alarms = AlarmBook(host.state_directory, host.audit)
        self._rules = AlarmRules(self._alarms)
        self.past_tasks = PastTasks(host.state_directory)

    @property
    def records(self) -> RobotRecords:
        """See Source."""
        maintenance = self._host.features.loaded.get("maintenance")
        has_tasks = self._host.tools.get(TASK_TOOL) is not None
        return RobotRecords(
            alarms=self._alarms,
            maintenance=maintenance if isinstance(maintenance, MaintenanceFeature) else None,
            tasks=self.past_tasks if has_tasks else None,
        )

    def on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        """Listener of `Events.health`."""
        report = view.report if health in FAULTS else None
        why = "" if report is None else report.error
        self._health_lines.add(view.kind, health, before=before, why=why)
        reason = view.still_reason(time.monotonic()) if health in FAULTS else None
        self._rules.on_health(view.kind, health, reason)

    def on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        """Listener of `Events.fault`."""
        self.shown_events.add(
            "fault", f"{module}: {what}: {facts.get('explanation', '')}", is_bad=True
        )
        self._rules.on_fault(module, what, facts)

    def now_s(self) -> float:
        """See Source."""
        return time.monotonic()

    def config(self) -> Config:
        """See Source."""
        return self._host.config

    def profile(self) -> RobotProfile:
        """See Source."""
        return robot_profile(self._host.config, self._host.registry)

    def snapshot(self) -> PageState:
        """See Source."""
        statuses = [ModuleStatus.of(view) for view in self._host.modules.views()]
        stop = self._host.loop.emergency_stop
        is_latched = stop.is_latched()
        instruction = next(
            (status.instruction for status in statuses if status.module == "inference"), ""
        )
        control = next(status.metrics for status in statuses if status.module == "control")
        return PageState(
            modules=tuple(_row(status) for status in statuses),
            is_latched=is_latched,
            cause=stop.cause() if is_latched else "",
            why_still=self._host.why_still(),
            instruction=instruction,
            limit=control.get("limit", ""),
            limit_counts=limit_counts(control),
            unchecked=self._host.loop.unchecked,
        )

    @property
    def release_command(self) -> str:
        """See Source."""
        return self._host.loop.emergency_stop.file.release_command

    def is_latched(self) -> bool:
        """See Source."""
        return self._host.loop.emergency_stop.is_latched()

    def poll(self) -> None:
        """See Source."""
        for record in self._audit.read_new():
            if record["verdict"] in _SHOWN_VERDICTS:
                add_record(self.shown_events, record)
            self._rules.on_record(record)
        self._rules.poll()
        report = self._host.modules.view("inference").report
        self._rules.on_metrics({} if report is None else report.metrics)
        self._alarms.save()

    def subscribe(
        self, message_type: type[M], topic: str, callback: Callable[[M], None]
    ) -> Callable[[], None]:
        """See Source."""
        return self._host.subscribe(message_type, topic, callback)

    def press_stop(self, who: str) -> str:
        """See Source."""
        stop = self._host.loop.emergency_stop
        confirmed, took_s = stop.latch(
            self._host.config.namespace, who=who, reason="pressed in the live view"
        )
        return (
            f"Latched after {took_s:.2f} s; confirmed by "
            f"{', '.join(confirmed) or 'no module: none runs'}."
        )


def _row(status: ModuleStatus) -> ModuleRow:
    chosen = chosen_plugin(status.started_with)
    error = "" if status.error is None else status.error.message
    return module_row(status.module, status.health, status, error=error, chosen=chosen)
