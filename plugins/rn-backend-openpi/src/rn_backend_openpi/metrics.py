"""Prometheus metrics of a policy server, and their endpoint.

Labels are names of models from the server's own file and words of this module: no data sent by a
robot becomes a label.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from socketserver import BaseServer
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)

from rn_backend_openpi.description import READY
from rn_backend_openpi.messages import Document
from rn_backend_openpi.statistics import BOUNDS_S
from roboneuron import ConfigurationError

_PREFIX = "roboneuron_policy"
_MODEL = ["model"]
_COUNTS = {
    "batches": "Forward passes of the model.",
    "observations": "Observations processed by the model.",
    "restarts": "Starts of the model's process after the first.",
}
_GAUGES = {
    "clients": "Robots that are connected to the model.",
    "waiting": "Observations queued for the model.",
    "busy_s": "Duration of the current forward pass so far [s].",
}
_OUTCOMES = ("answered", "refused", "errors")
_JOIN_S = 5.0


class PolicyMetrics:
    """A collector of prometheus_client, evaluated at each scrape.

    Args:
        status: statistics of the server, see `PolicyServer.status`.
    """

    def __init__(self, status: Callable[[], Document]) -> None:
        self._status = status

    def collect(self) -> Iterator[Metric]:
        """All metrics; called on the endpoint's thread."""
        told = self._status()
        rows = [([name], one) for name, one in told["models"].items()]
        yield GaugeMetricFamily(f"{_PREFIX}_robots", "Robots connected.", told["robots"])
        yield CounterMetricFamily(
            f"{_PREFIX}_refused_connections",
            "Connections that were not admitted as a robot's.",
            told["refused_connections"],
        )
        ready = GaugeMetricFamily(f"{_PREFIX}_ready", "1 if the model is ready.", labels=_MODEL)
        for labels, one in rows:
            ready.add_metric(labels, float(one["state"] == READY))
        yield ready
        for key, what in _COUNTS.items():
            counter = CounterMetricFamily(f"{_PREFIX}_{key}", what, labels=_MODEL)
            for labels, one in rows:
                counter.add_metric(labels, one.get(key, 0))
            yield counter
        for key, what in _GAUGES.items():
            gauge = GaugeMetricFamily(f"{_PREFIX}_{key}", what, labels=_MODEL)
            for labels, one in rows:
                gauge.add_metric(labels, one.get(key, 0))
            yield gauge
        requests = CounterMetricFamily(
            f"{_PREFIX}_requests", "Answers to robots by outcome.", labels=[*_MODEL, "outcome"]
        )
        for labels, one in rows:
            for outcome in _OUTCOMES:
                requests.add_metric([*labels, outcome], one.get(outcome, 0))
        yield requests
        lost = CounterMetricFamily(
            f"{_PREFIX}_lost",
            "Observations lost because the model was not available.",
            labels=_MODEL,
        )
        served = HistogramMetricFamily(
            f"{_PREFIX}_served_seconds",
            "Time from a complete request to its answer.",
            labels=_MODEL,
        )
        for name, model in told["models"].items():
            lost.add_metric([name], model["lost"])
            _add(served, [name], model["served_times"])
        yield lost
        yield served
        for key, what in (("model", "Forward pass."), ("queue", "Observation in the queue.")):
            times = HistogramMetricFamily(f"{_PREFIX}_{key}_seconds", what, labels=_MODEL)
            for labels, one in rows:
                if f"{key}_times" in one:
                    _add(times, labels, one[f"{key}_times"])
            yield times


def _add(family: HistogramMetricFamily, labels: Sequence[str], times: Document) -> None:
    """Add a document of `Times`."""
    total, buckets = 0, list[tuple[str, float]]()
    for bound, count in zip([*map(str, BOUNDS_S), "+Inf"], times["counts"], strict=True):
        total += count
        buckets.append((bound, float(total)))
    family.add_metric(labels, buckets, times["sum_s"])


class _ScrapeHandler(WSGIRequestHandler):
    """One scrape, with a time limit, because scrapes are answered one after the other."""

    timeout = 2.0

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, so that clients cannot fill the log."""


class _MetricsServer(WSGIServer):
    request_queue_size = 8

    def handle_error(self, request: object, client_address: object) -> None:
        """Log nothing: a connection that ended early is no fault."""


class MetricsEndpoint:
    """Serves the metrics of a policy server until `close`.

    Args:
        host, port: address; port 0 for a free one.
        status: see `PolicyMetrics`.

    Raises:
        ConfigurationError: the address cannot be used.
    """

    def __init__(self, host: str, port: int, status: Callable[[], Document]) -> None:
        registry = CollectorRegistry()
        registry.register(PolicyMetrics(status))
        try:
            self._server = _MetricsServer((host, port), _ScrapeHandler)
        except OSError as error:
            raise ConfigurationError(
                f"Metrics cannot be served at {host}:{port}: {error.strerror or error}.",
                hint="Choose another metrics_port in [listen].",
            ) from error
        self._server.set_app(make_wsgi_app(registry))
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=_serve, args=(self._server,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(_JOIN_S)


def _serve(server: BaseServer) -> None:
    server.serve_forever(poll_interval=0.1)
