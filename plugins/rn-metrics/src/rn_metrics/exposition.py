"""The endpoint of a process: the metrics of one robot as they are, those of several with the label `robot`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, ClassVar

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import Metric

_JOIN_S = 2.0


class Exposition:
    """Serves registries at an address from the first `join` to the last `leave`; callable from any thread.

    The robots of a server share the address that their configuration shares: a port belongs to the process, and so does
    the table of those in use. Source of the format: one family for each name (Prometheus text format 0.0.4).
    """

    _in_use: ClassVar[dict[tuple[str, int], Exposition]] = {}
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, host: str, port: int) -> None:
        """Listen. Raises OSError when the address cannot be used."""
        self._address = (host, port)
        self._robots: dict[str, CollectorRegistry] = {}
        own = CollectorRegistry()
        own.register(self)
        self._server, self._thread = start_http_server(port, host, registry=own)
        self.port: int = self._server.server_port

    @classmethod
    def join(cls, host: str, port: int, robot: str, registry: CollectorRegistry) -> Exposition:
        """Serve the metrics of a robot at an address, beside those of others there.

        Args:
            host, port: as configured; robots with port 0 share a free one.
            robot: its namespace.
            registry: its metrics.

        Raises:
            OSError: the address cannot be used.
        """
        with cls._lock:
            found = cls._in_use.get((host, port))
            if found is None:
                found = cls._in_use[host, port] = cls(host, port)
            found._robots = {**found._robots, robot: registry}  # a scrape may be reading the one before
            return found

    def leave(self, robot: str) -> None:
        """Serve this robot no longer; the last one ends the endpoint."""
        with self._lock:
            self._robots = {name: registry for name, registry in self._robots.items() if name != robot}
            if self._robots or self._in_use.get(self._address) is not self:
                return
            del self._in_use[self._address]
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(_JOIN_S)

    def collect(self) -> Iterator[Metric]:
        """See prometheus_client; on the thread of a scrape."""
        robots = self._robots
        families: dict[str, Metric] = {}
        for robot, registry in robots.items():
            label: dict[str, Any] = {"robot": robot} if len(robots) > 1 else {}
            for metric in registry.collect():
                family = families.setdefault(metric.name, Metric(metric.name, metric.documentation, metric.type))
                family.samples += [sample._replace(labels={**label, **sample.labels}) for sample in metric.samples]
        yield from families.values()
