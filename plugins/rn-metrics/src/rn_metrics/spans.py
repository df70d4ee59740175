"""Spans of a tool call: the request, each decision of the gate on it, and each message published
for it.

The MCP SDK creates the span of the request, the core that of a message; both do nothing until this
module sets a tracer provider. The gate's decision becomes a span when the audit has its record.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from opentelemetry import trace
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import BatchSpanProcessor

from roboneuron import MissingDependencyError, __version__, install_command
from roboneuron.feature import AuditRecord

if TYPE_CHECKING:
    from opentelemetry.sdk.trace.export import SpanExporter

_REFUSALS = ("refused", "would_refuse")


class Spans:
    """Sends spans from `open` to `close`.

    Args:
        exporter: receives them in batches, on a separate thread.
    """

    def __init__(self, exporter: SpanExporter) -> None:
        resource = Resource.create({"service.name": "roboneuron", "service.version": __version__})
        self.provider = TracerProvider(resource=resource)
        self.provider.add_span_processor(BatchSpanProcessor(exporter))
        self._tracer = self.provider.get_tracer("roboneuron")

    def open(self) -> None:
        """Become the tracer provider of this process; OpenTelemetry keeps the first one."""
        trace.set_tracer_provider(self.provider)

    def close(self) -> None:
        """Send the remaining spans, within the exporter's timeout; idempotent."""
        self.provider.shutdown()

    def on_decision(self, record: AuditRecord) -> None:
        """Listener of `Events.decision`, on the thread of the call, whose span is the
        present one.
        """
        attributes = {
            "roboneuron.tool": record.tool,
            "roboneuron.endpoint": record.endpoint,
            "roboneuron.verdict": record.verdict,
            "roboneuron.rule": record.rule,
        }
        name = f"gate {record.endpoint or record.tool}"
        with self._tracer.start_as_current_span(name, attributes=attributes) as span:
            if record.verdict in _REFUSALS:
                span.set_status(trace.StatusCode.ERROR, record.reason)


def otlp_exporter(endpoint: str) -> SpanExporter:
    """Create an exporter that sends spans to a collector over HTTP.

    Raises:
        MissingDependencyError: the extra `otlp` of this package is not installed.
    """
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    except ImportError as error:
        raise MissingDependencyError(
            "[metrics] traces needs the OTLP exporter.",
            hint=f"Run: {install_command('rn-metrics[otlp]')}.",
        ) from error
    return OTLPSpanExporter(endpoint=endpoint)
