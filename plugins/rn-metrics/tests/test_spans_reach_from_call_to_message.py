"""Spans of the gate and of a message belong to the call that made them, across threads."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from types import SimpleNamespace

import anyio
import pytest
from anyio import to_thread
from opentelemetry import trace
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from rn_metrics.spans import Spans, otlp_exporter
from roboneuron.direct_path.writer import TopicWriter
from roboneuron.gate.audit import AuditLog, AuditRecord

SENT = AuditRecord(
    who="agent", role="admin", tool="publish_wheels", endpoint="wheels", verdict="allowed"
)
REFUSED = AuditRecord(
    who="agent",
    role="admin",
    tool="publish_wheels",
    endpoint="wheels",
    verdict="refused",
    rule="rate",
    reason="slow",
)


@pytest.fixture
def finished(tmp_path):
    """An audit that is traced, and the spans that have ended."""
    kept = InMemorySpanExporter()
    spans = Spans(InMemorySpanExporter())
    spans.provider.add_span_processor(SimpleSpanProcessor(kept))
    spans.open()
    audit = AuditLog(tmp_path / "audit.jsonl", lambda: 0)
    audit.on_record = spans.on_decision
    yield audit, kept, spans.provider
    audit.close()
    spans.close()


def test_a_call_has_the_decisions_and_the_message_below_it(finished):
    audit, kept, provider = finished
    published = []
    writer = TopicWriter(None, str, "std_msgs/msg/String", "/robot/cmd_vel")
    writer._publisher = SimpleNamespace(publish=published.append)

    def work():
        audit.write(REFUSED)
        audit.write(SENT)
        writer.send("forward", stamped=False)

    async def call():
        with provider.get_tracer("mcp-python-sdk").start_as_current_span(
            "tools/call publish_wheels"
        ):
            await to_thread.run_sync(work)

    anyio.run(call)
    assert published == ["forward"]
    refused, allowed, message, request = kept.get_finished_spans()
    assert [span.name for span in (refused, allowed)] == ["gate wheels"] * 2
    assert message.name == "publish /robot/cmd_vel"
    assert {span.parent.span_id for span in (refused, allowed, message)} == {
        request.context.span_id
    }
    assert refused.status.status_code is trace.StatusCode.ERROR
    assert refused.attributes["roboneuron.rule"] == "rate"


def test_spans_come_to_a_collector_over_http():
    came = []

    class Collector(BaseHTTPRequestHandler):
        def do_POST(self):
            came.append((self.path, self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Collector) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        spans = Spans(otlp_exporter(f"http://127.0.0.1:{server.server_port}/v1/traces"))
        with spans.provider.get_tracer("x").start_as_current_span("tools/call wave"):
            spans.on_decision(SENT)
        spans.close()  # sends what is left
        server.shutdown()
        thread.join()
    assert came[0][0] == "/v1/traces"
    assert b"tools/call wave" in b"".join(body for _, body in came)
    assert b"gate wheels" in b"".join(body for _, body in came)
