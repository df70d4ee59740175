"""The feature: a Prometheus endpoint and spans, each when the configuration asks for it."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rn_metrics.options import MetricsOptions
from roboneuron import ConfigurationError, Feature, Host, Tool
from roboneuron.config import Config
from roboneuron.supervisor.changes import Periodic

if TYPE_CHECKING:
    from rn_metrics.exposition import Exposition
    from rn_metrics.meters import Meters
    from rn_metrics.spans import Spans

log = logging.getLogger(__name__)
_LOOK_S = 0.1
"""Modules report every 0.2 s."""


class MetricsFeature(Feature[MetricsOptions]):
    """Counts, serves and sends; does nothing at all unless `[metrics]` asks for it."""

    meters: Meters | None = None
    spans: Spans | None = None
    port = 0
    """Where metrics are served, once they are."""
    _exposition: Exposition | None = None
    _robot = ""
    _looking: Periodic | None = None

    def check(self, config: Config) -> None:
        """Check that the exporter is there when traces are to be sent."""
        if self.options.traces:
            from rn_metrics.spans import otlp_exporter  # heavy

            otlp_exporter(self.options.otlp_endpoint).shutdown()

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """None; what happens is listened to from now on."""
        if self.options.prometheus:
            from rn_metrics.meters import Meters  # heavy

            meters = self.meters = Meters(host)
            host.events.health.listen(meters.on_health)
            host.events.fault.listen(meters.on_fault)
            host.events.decision.listen(meters.on_decision)
            host.events.open.listen(lambda: host.server.middleware.append(meters))  # not there before
        if self.options.traces:
            from rn_metrics.spans import Spans, otlp_exporter  # heavy

            self.spans = Spans(otlp_exporter(self.options.otlp_endpoint))
            self.spans.open()
            host.events.decision.listen(self.spans.on_decision)
        return ()

    def start(self, host: Host) -> None:
        """Serve the metrics, those of several robots at one address.

        Raises:
            ConfigurationError: the address cannot be used.
        """
        if self.meters is None:
            return
        from rn_metrics.exposition import Exposition  # heavy

        self._robot = host.config.namespace
        try:
            self._exposition = Exposition.join(self.options.host, self.options.port, self._robot, self.meters.registry)
        except OSError as error:
            raise ConfigurationError(
                f"[metrics] {self.options.host}:{self.options.port} cannot be used: {error.strerror or error}.",
                hint="Choose another `port`.",
            ) from error
        self.port = self._exposition.port
        log.info("Metrics are at http://%s:%d/metrics.", self.options.host, self.port)
        self._looking = Periodic("metrics", _LOOK_S, self.meters.look)
        self._looking.start()

    def close(self) -> None:
        """End everything, and send what is left."""
        if self._looking is not None:
            self._looking.close()
        exposition, self._exposition = self._exposition, None
        if exposition is not None:
            exposition.leave(self._robot)
        if self.spans is not None:
            self.spans.close()
            self.spans = None
