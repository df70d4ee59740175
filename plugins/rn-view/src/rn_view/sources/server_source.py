"""What the server itself knows, and the calls of tools for the buttons."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar

import anyio
from anyio import to_thread

from rn_standard.http.operator_lease import OperatorLease
from rn_standard.ops.maintenance import MaintenanceFeature
from rn_standard.teleoperation.feature import TELEOPERATION, Teleoperation
from rn_standard.tools_loop.results import ModuleStatus
from rn_view.diagnostics.active_limits import limit_counts
from rn_view.diagnostics.alarm_rules import AlarmRules
from rn_view.diagnostics.alarms import AlarmBook
from rn_view.diagnostics.event_list import AuditReader, EventList, add_record, failure_of
from rn_view.diagnostics.module_health import HealthLines
from rn_view.sources.records import RobotRecords
from rn_view.sources.source import ModuleRow, PageState, said_of
from rn_view.tasks.past_tasks import TASK_TOOL, PastTasks
from rn_view.teleoperation.sample_socket import PageTeleoperator
from rn_view.teleoperation.stick_panel import RATE_HZ
from roboneuron import Host, RobotProfile
from roboneuron.feature import (
    FAULTS,
    Config,
    Health,
    Holder,
    ModuleKind,
    ModuleView,
    Registry,
    load_profile,
)

T = TypeVar("T")
M = TypeVar("M")
_ORDER: tuple[ModuleKind, ...] = ("robot", "perception", "inference", "control")
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
"""What is allowed is in the list as a tool call already."""


class LiveSource:
    """Source of a view in the server's own process."""

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
        why, hint = ("", "") if report is None else (report.error, report.error_hint)
        self._health_lines.add(view.kind, health, before=before, why=why)
        self._rules.on_health(view.kind, health, why, hint)

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
        statuses = [ModuleStatus.of(self._host.modules.view(kind)) for kind in _ORDER]
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
            instruction=instruction,
            limit=control.get("limit", ""),
            limit_counts=limit_counts(control),
        )

    def is_latched(self) -> bool:
        """See Source."""
        return self._host.loop.emergency_stop.is_latched()

    def look(self) -> None:
        """See Source."""
        for record in self._audit.read_new():
            if record["verdict"] in _SHOWN_VERDICTS:
                add_record(self.shown_events, record)
            self._rules.on_record(record)
        self._rules.look()
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


def robot_profile(config: Config, registry: Registry) -> RobotProfile:
    """Profile of the configured robot. Raises RoboNeuronError when its plugin cannot be used."""
    return load_profile(registry, config.robot.name)


def _row(status: ModuleStatus) -> ModuleRow:
    text = f"{status.error.message}" if status.error is not None else ""
    waits = f"waits for {status.waiting_for}" if status.waiting_for else ""
    text = text or waits or said_of(status.note, status.metrics)
    chosen = status.started_with
    named = next(
        (chosen[key] for key in ("robot", "source", "backend", "controller") if key in chosen), ""
    )
    return ModuleRow(
        kind=status.module,
        health=status.health,
        text=text,
        chosen=named,
        rate_hz=status.rate_hz,
        latency_ms=status.latency_ms,
        latency_p99_ms=status.latency_p99_ms,
        age_ms=status.age_ms,
        dropped=status.dropped,
    )


class LiveOperator:
    """Calls tools on the server's event loop, where every client's calls are made.

    Args:
        host: the server.
        lease: told who has a page open, and who has left, so that another client may operate the
            robot.
    """

    def __init__(self, host: Host, lease: OperatorLease | None = None) -> None:
        self._host = host
        self._lease = lease
        self.loop: asyncio.AbstractEventLoop | None = None

    def call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> Future[str]:
        """See Operator."""
        if self.loop is None:
            failed: Future[str] = Future()
            failed.set_result("The server does not serve clients yet.")
            return failed
        return asyncio.run_coroutine_threadsafe(self._call(holder, tool, arguments), self.loop)

    def fetch(self, holder: Holder, tool: str) -> Future[Mapping[str, object]]:
        """See Operator."""
        if self.loop is None:
            nothing: Future[Mapping[str, object]] = Future()
            nothing.set_result({})
            return nothing
        return asyncio.run_coroutine_threadsafe(self._fetch(holder, tool), self.loop)

    def has(self, tool: str) -> bool:
        """See Operator."""
        return self._host.tools.get(tool) is not None

    def present(self, holder: Holder) -> AbstractContextManager[None]:
        """See Operator; an open page renews the lease like an open stream."""
        return nullcontext() if self._lease is None else self._lease.present(holder.who)

    def leave(self, holder: Holder) -> None:
        """See Operator; releases nothing for a holder with a token, who may have other clients."""
        if holder.client and self._lease is not None:
            self._lease.release(holder.who)

    def lend(self, name: str, source: PageTeleoperator | None) -> bool:
        """See Operator."""
        feature = self._host.features.loaded.get(TELEOPERATION)
        if not isinstance(feature, Teleoperation):
            return False
        if source is None:
            feature.take_back(name)
        else:
            feature.lend(name, source, RATE_HZ)
        return True

    async def _call(self, holder: Holder, tool: str, arguments: dict[str, object]) -> str:
        result = await self._host.tools.call(tool, arguments, _Context(holder))
        return failure_of(result.model_dump(mode="json", by_alias=True))

    async def _fetch(self, holder: Holder, tool: str) -> Mapping[str, object]:
        result = await self._host.tools.call(tool, {}, _Context(holder))
        return result.structured_content or {}


class _Context:
    """CallContext of a button."""

    def __init__(self, holder: Holder) -> None:
        self.who, self.role = holder.who, holder.role

    async def run(
        self,
        work: Callable[[Callable[[str], None]], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """See CallContext; `on_leave` is ignored, since no button starts a motion that ends with
        its page.
        """
        thread = anyio.CapacityLimiter(1)
        try:
            return await to_thread.run_sync(
                lambda: work(lambda _: None), abandon_on_cancel=True, limiter=thread
            )
        except anyio.get_cancelled_exc_class():
            on_cancel()
            raise

    async def ask(self, question: str, what: str = "") -> str | None:
        """See CallContext; a button cannot ask a person, so the emergency stop is not released from
        the page.
        """
        return None
