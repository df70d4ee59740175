"""Prometheus metrics of a policy server.

Labels are names of models from the server's own file and words of this module: no data sent by a
robot becomes a label.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from prometheus_client import CollectorRegistry
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    Metric,
)
from prometheus_client.exposition import generate_latest

from rn_backend_openpi.description import READY
from rn_backend_openpi.messages import Document
from rn_backend_openpi.statistics import BOUNDS_S

_PREFIX = "roboneuron_policy_"
_MODEL = ["model"]
_COUNTS = {
    "batches": "Forward passes of the model.",
    "observations": "Observations processed by the model.",
    "restarts": "Starts of the model's process after the first.",
    "lost": "Observations lost because the model was not available.",
}
_GAUGES = {
    "ready": "1 if the model is ready.",
    "clients": "Robots that are connected to the model.",
    "waiting": "Observations queued for the model.",
    "busy_s": "Duration of the current forward pass so far [s].",
}
_TIMES = {
    "served": "Time from a complete request to its answer.",
    "model": "Forward pass.",
    "queue": "Observation in the queue.",
}
_OUTCOMES = ("answered", "refused", "errors")


class PolicyMetrics:
    """A collector of prometheus_client, evaluated at each scrape.

    Args:
        status: statistics of the server, see `PolicyServer.status`.
    """

    def __init__(self, status: Callable[[], Document]) -> None:
        self._status = status
        self._registry = CollectorRegistry()
        self._registry.register(self)

    def page(self) -> str:
        """All metrics in Prometheus' text format 0.0.4."""
        return generate_latest(self._registry).decode()

    def collect(self) -> Iterator[Metric]:
        """All metrics; called by the registry."""
        told = self._status()
        models = {
            name: {**one, "ready": float(one["state"] == READY)}
            for name, one in told["models"].items()
        }
        yield GaugeMetricFamily(_PREFIX + "robots", "Robots connected.", told["robots"])
        yield CounterMetricFamily(
            _PREFIX + "refused_connections",
            "Connections that were not admitted as a robot's.",
            told["refused_connections"],
        )
        for kind, names in ((CounterMetricFamily, _COUNTS), (GaugeMetricFamily, _GAUGES)):
            for key, what in names.items():
                family = kind(_PREFIX + key, what, labels=_MODEL)
                for name, one in models.items():
                    family.add_metric([name], one.get(key, 0))
                yield family
        requests = CounterMetricFamily(
            _PREFIX + "requests", "Answers to robots by outcome.", labels=[*_MODEL, "outcome"]
        )
        for name, one in models.items():
            for outcome in _OUTCOMES:
                requests.add_metric([name, outcome], one.get(outcome, 0))
        yield requests
        for key, what in _TIMES.items():
            times = HistogramMetricFamily(f"{_PREFIX}{key}_seconds", what, labels=_MODEL)
            for name, one in models.items():
                if f"{key}_times" in one:
                    found = one[f"{key}_times"]
                    times.add_metric([name], _buckets(found["counts"]), found["sum_s"])
            yield times


def _buckets(counts: list[int]) -> list[tuple[str, float]]:
    """The counts of `Times.document`, each with those of the intervals below."""
    totals = [float(sum(counts[: place + 1])) for place in range(len(counts))]
    return list(zip([*map(str, BOUNDS_S), "+Inf"], totals, strict=True))
