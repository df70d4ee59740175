"""The feature: the live view in the server's process."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

from anyio import from_thread

from rn_serve_http.feature import HttpFeature
from rn_serve_http.options import HttpOptions
from rn_serve_http.plugin import FEATURE as HTTP
from rn_serve_http.tokens import TokenFiles, read_tokens
from rn_view.access import Admission, check_address, host_rules
from rn_view.happenings import ToolCalls
from rn_view.live import LiveOperator, LiveSource
from rn_view.options import ViewOptions
from roboneuron import Feature, Host, Tool
from roboneuron.config import Config, feature_options

if TYPE_CHECKING:
    from rn_view.viewer import Viewer


class ViewFeature(Feature[ViewOptions]):
    """Serves the page when `[view] enabled` says so."""

    viewer: Viewer | None = None

    def check(self, config: Config) -> None:
        """Check address, tokens and hosts, when they will be used."""
        if self.options.enabled:
            http = cast(HttpOptions, feature_options(HTTP, config))
            host_rules(self.options, http)
            check_address(self.options, read_tokens(http.tokens, os.environ))

    def tools(self, host: Host) -> Sequence[Tool[Any]]:
        """None; what happens is listened to from now on."""
        if self.options.enabled:
            self._source = LiveSource(host)
            host.events.health.listen(self._source.on_health)
            host.events.fault.listen(self._source.on_fault)
            calls = ToolCalls(self._source.happenings)
            host.events.open.listen(lambda: host.server.middleware.append(calls))  # not there before
        return ()

    def start(self, host: Host) -> None:
        """Begin to serve the page."""
        if not self.options.enabled:
            return
        from rn_view.viewer import Viewer  # heavy

        http = host.feature("http", HttpFeature)
        admission = Admission(
            tokens=TokenFiles(http.options.tokens, os.environ), rules=host_rules(self.options, http.options)
        )
        operator = LiveOperator(host, http.lease)
        with contextlib.suppress(RuntimeError):  # not called by a server that serves
            operator.loop = from_thread.run_sync(asyncio.get_running_loop)
        self.viewer = Viewer(self.options, self._source, admission, operator)
        self.viewer.open()

    def close(self) -> None:
        """End the page."""
        if self.viewer is not None:
            self.viewer.close()
