"""The metrics: counted at events, or read from the modules' newest reports on a scrape."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Counter, Histogram
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from roboneuron import Host
from roboneuron.feature import EXPLANATIONS, FAULTS, AuditRecord, EndedCall, Health, ModuleView

OK = "ok"
UNKNOWN = "unknown"
"""Label of an unknown tool: clients could create any number of labels otherwise."""
TASK_TOOL = "run_task"
OUTCOMES = ("succeeded", "failed", "timed_out", "stopped", "unclear", "taken_over")
"""Outcomes of tasks. Each has a counter from the beginning, so that a rate has a starting value."""
_CALL_BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
_TASK_BUCKETS_S = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 120.0, 300.0, 600.0)
_MODULE_BUCKETS_S = (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.25, 0.5, 1.0, 2.5)
_STATE_GAUGES = (
    ("rate_hz", "rate_hertz", "Rate of the module's output.", 1.0),
    ("latency_ms", "latency_median_seconds", "Median from the input's stamp to the output.", 1e-3),
    ("latency_p99_ms", "latency_p99_seconds", "99th percentile of the same.", 1e-3),
    ("age_ms", "age_seconds", "Age of the newest input or output.", 1e-3),
)


class Meters:
    """All metrics of one server, in a separate registry; usable from any thread."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self.registry = CollectorRegistry()
        self.calls = Counter(
            "roboneuron_tool_calls",
            "Tool calls by result: ok, or the code of the error.",
            ("tool", "result"),
            registry=self.registry,
        )
        self.call_s = Histogram(
            "roboneuron_tool_call_seconds",
            "How long tool calls took.",
            ("tool",),
            buckets=_CALL_BUCKETS_S,
            registry=self.registry,
        )
        self.verdicts = Counter(
            "roboneuron_gate_verdicts",
            "Decisions of the gate, by the rule that applied.",
            ("endpoint", "verdict", "rule"),
            registry=self.registry,
        )
        self.stops = Counter(
            "roboneuron_emergency_stops",
            "Emergency stops that were latched.",
            registry=self.registry,
        )
        self.faults = Counter(
            "roboneuron_faults", "Faults of modules.", ("module", "what"), registry=self.registry
        )
        self.switches = Counter(
            "roboneuron_switches",
            "Modules that were switched while the robot worked, by result.",
            ("module", "result"),
            registry=self.registry,
        )
        self.tasks = Counter(
            "roboneuron_tasks", "Tasks that have ended.", ("outcome",), registry=self.registry
        )
        self.task_s = Histogram(
            "roboneuron_task_seconds",
            "How long tasks took.",
            ("outcome",),
            buckets=_TASK_BUCKETS_S,
            registry=self.registry,
        )
        self.latency_s = Histogram(
            "roboneuron_module_latency_seconds",
            "Median latencies that a module reported, one for each report.",
            ("module",),
            buckets=_MODULE_BUCKETS_S,
            registry=self.registry,
        )
        for outcome in OUTCOMES:
            self.tasks.labels(outcome)
        self._seen_s: dict[str, float] = {}
        self._latched = False
        self.registry.register(_Reports(host))

    def on_health(self, view: ModuleView, before: Health, health: Health) -> None:
        """Listener of `Events.health`."""
        if health in FAULTS:
            self.faults.labels(view.kind, health).inc()

    def on_fault(self, module: str, what: str, facts: Mapping[str, object]) -> None:
        """Listener of `Events.fault`."""
        self.faults.labels(module, what).inc()

    def on_decision(self, record: AuditRecord) -> None:
        """Listener of `Events.decision`."""
        if record.endpoint:
            self.verdicts.labels(record.endpoint, record.verdict, record.rule).inc()

    def look(self) -> None:
        """Record the latency of each new report, and detect an emergency stop from any source."""
        for view in self._host.modules.views():
            report = view.report
            if (
                report is None
                or report.latency_ms is None
                or self._seen_s.get(view.kind) == report.received_s
            ):
                continue
            self._seen_s[view.kind] = report.received_s
            self.latency_s.labels(view.kind).observe(report.latency_ms / 1e3)
        latched = self._host.loop.emergency_stop.is_latched()
        if latched and not self._latched:
            self.stops.inc()
        self._latched = latched

    def on_call(self, ended: EndedCall) -> None:
        """Listener of `Events.call_ended`."""
        tool = UNKNOWN if ended.call.found is None else ended.call.name
        result = "cancelled" if ended.outcome == "cancelled" else ended.code or OK
        self.calls.labels(tool, result).inc()
        self.call_s.labels(tool).observe(ended.took_s)
        if tool.startswith("switch_"):
            self.switches.labels(tool.removeprefix("switch_"), result).inc()
        outcome = outcome_of(ended)
        if outcome:
            self.tasks.labels(outcome).inc()
            self.task_s.labels(outcome).observe(ended.took_s)


def outcome_of(ended: EndedCall) -> str:
    """Outcome of a call's task; empty for other calls, and for a task that was not begun."""
    if ended.call.name != TASK_TOOL or ended.answer is None:
        return ""
    outcome = str(ended.answer.structured.get("outcome", ""))
    return outcome if outcome in OUTCOMES else ""


class _Reports:
    """Reports of the modules, read on a scrape."""

    def __init__(self, host: Host) -> None:
        self._host = host

    def collect(self) -> Iterator[Metric]:
        """See prometheus_client."""
        views = self._host.modules.views()
        reports = [
            (view.kind, view.report)
            for view in views
            if view.phase == "running" and view.report is not None
        ]
        health = GaugeMetricFamily(
            "roboneuron_module_health", "1 for how a module is.", labels=("module", "health")
        )
        now_s = time.monotonic()
        for view in views:
            present = view.health(now_s)
            for word in EXPLANATIONS:
                health.add_metric((view.kind, word), float(word == present))
        yield health
        for field, name, text, unit in _STATE_GAUGES:
            gauge = GaugeMetricFamily(f"roboneuron_module_{name}", text, labels=("module",))
            for kind, report in reports:
                value = getattr(report, field)
                if value is not None:
                    gauge.add_metric((kind,), value * unit)
            yield gauge
        published = CounterMetricFamily(
            "roboneuron_module_published", "Outputs of a module.", labels=("module",)
        )
        dropped = CounterMetricFamily(
            "roboneuron_module_dropped",
            "Inputs that were not acted on, by reason.",
            labels=("module", "reason"),
        )
        errors = CounterMetricFamily(
            "roboneuron_module_errors", "Failures of a module.", labels=("module",)
        )
        for kind, report in reports:
            published.add_metric((kind,), report.published)
            errors.add_metric((kind,), report.error_count)
            for reason, count in report.dropped_by.items():
                dropped.add_metric((kind, reason), count)
        yield published
        yield dropped
        yield errors
        latched = GaugeMetricFamily(
            "roboneuron_emergency_stop", "1 while the emergency stop is latched."
        )
        latched.add_metric((), float(self._host.loop.emergency_stop.is_latched()))
        yield latched
