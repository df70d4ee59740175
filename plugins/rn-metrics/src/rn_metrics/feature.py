"""The feature: a Prometheus endpoint and spans, each if configured."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rn_metrics.options import MetricsOptions
from rn_standard.http.addresses import bind
from rn_standard.http.feature import HttpFeature
from rn_standard.http.options import HttpOptions
from rn_standard.http.origins import HostRules
from rn_standard.http.tokens import TokenFiles, read_tokens
from roboneuron import Feature, Host, Tool
from roboneuron.feature import Config, Periodic

if TYPE_CHECKING:
    from rn_metrics.exposition import Exposition
    from rn_metrics.meters import Meters
    from rn_metrics.spans import Spans

log = logging.getLogger(__name__)
_LOOK_S = 0.1
"""Polling period; modules report every 0.2 s."""


class MetricsFeature(Feature[MetricsOptions]):
    """Counts, serves and sends; does nothing unless `[metrics]` is configured."""

    meters: Meters | None = None
    spans: Spans | None = None
    port = 0
    """Port of the endpoint, once it serves."""
    _exposition: Exposition | None = None
    _robot = ""
    _looking: Periodic | None = None

    def check(self, config: Config) -> None:
        """Check address and tokens if metrics are served, and the exporter if traces are sent."""
        if self.options.prometheus:
            http = HttpOptions.of(config)
            host_rules(self.options.host, http)
            bind("metrics", self.options.host, 0, read_tokens(http.tokens, os.environ)).close()
        if self.options.traces:
            from rn_metrics.spans import otlp_exporter  # heavy

            otlp_exporter(self.options.otlp_endpoint).shutdown()

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return no tools; register the listeners."""
        if self.options.prometheus:
            from rn_metrics.meters import Meters  # heavy

            meters = self.meters = Meters(host)
            host.events.health.listen(meters.on_health)
            host.events.fault.listen(meters.on_fault)
            host.events.decision.listen(meters.on_decision)
            host.events.call_ended.listen(meters.on_call)
        if self.options.traces:
            from rn_metrics.spans import Spans, otlp_exporter  # heavy

            self.spans = Spans(otlp_exporter(self.options.otlp_endpoint))
            self.spans.open()
            host.events.decision.listen(self.spans.on_decision)
        return ()

    def start(self, host: Host) -> None:
        """Serve the metrics, those of several robots at one address.

        Raises:
            ConfigurationError: the address cannot be used, or is reachable from other machines
                without a token.
        """
        if self.meters is None:
            return
        from rn_metrics.exposition import Exposition  # heavy

        self._robot = host.config.namespace
        http = host.feature("http", HttpFeature).options
        self._exposition = Exposition.join(
            self.options.host,
            self.options.port,
            self._robot,
            self.meters.registry,
            host_rules(self.options.host, http),
            TokenFiles(http.tokens, os.environ),
        )
        self.port = self._exposition.port
        log.info("Metrics are at http://%s:%d/metrics.", self.options.host, self.port)
        self._looking = Periodic("metrics", _LOOK_S, self.meters.look)
        self._looking.start()

    def close(self) -> None:
        """End everything, and send the remaining spans."""
        if self._looking is not None:
            self._looking.close()
        exposition, self._exposition = self._exposition, None
        if exposition is not None:
            exposition.leave(self._robot)
        if self.spans is not None:
            self.spans.close()
            self.spans = None


def host_rules(address: str, http: HttpOptions) -> HostRules:
    """The rules of `[http]` for the endpoint's own address. Raises ConfigurationError as
    HostRules.
    """
    return HostRules(http.model_copy(update={"host": address}))
