"""The feature `view`: starts the live view in the server's process."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from anyio import from_thread

from rn_standard.http.feature import HttpFeature
from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenFiles, read_tokens
from rn_view.diagnostics.event_list import ToolCalls
from rn_view.options import ViewOptions
from rn_view.sources.server_operator import ServerOperator
from rn_view.sources.server_source import ServerSource
from rn_view.tasks.past_tasks import TASK_TOOL
from rn_view.tasks.task_pictures import Camera, TaskPictures
from rn_view.web.access import ViewAccess, check_address, check_port, host_rules
from roboneuron import Feature, Host, Tool
from roboneuron.feature import CallPhase, Config, Interceptor, load_profile

if TYPE_CHECKING:
    from rn_view.web.view_server import ViewServer

HEARTBEAT = "heartbeat"
"""Tool of the feature `http` that only renews the lease."""


class ViewFeature(Feature[ViewOptions]):
    """Serves the page if `[view] enabled` is true."""

    viewer: ViewServer | None = None
    _shared: _SharedPage | None = None

    def check(self, config: Config) -> None:
        """Check address, tokens and hosts if the page is enabled."""
        if self.options.enabled:
            http = HttpOptions.of(config)
            host_rules(self.options, http)
            check_address(self.options, read_tokens(http.tokens, os.environ))

    def reserve(self, config: Config) -> None:
        """Check that the port is free. Refuses while another process listens on it."""
        if self.options.enabled:
            http = HttpOptions.of(config)
            check_port(self.options, read_tokens(http.tokens, os.environ))

    def tools(self, host: Host) -> Sequence[Tool]:
        """Add no tools, but listen to the server's events."""
        if self.options.enabled:
            self._source = ServerSource(host)
            host.events.health.listen(self._source.on_health)
            host.events.fault.listen(self._source.on_fault)
            calls = ToolCalls(self._source.shown_events, partial(_is_quiet, host))
            host.events.call_begun.listen(calls.begun)
            host.events.call_ended.listen(calls.ended)
        return ()

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """See `Feature.interceptors`: pictures of each task."""
        if not self.options.enabled:
            return ()
        pictures = TaskPictures(self._source.past_tasks, partial(_main_camera, host))
        return [
            Interceptor(
                name="task-pictures",
                phase=CallPhase.HANDLER,
                around=pictures.around,
                tools=frozenset({TASK_TOOL}),
            )
        ]

    def start(self, host: Host) -> None:
        """Serve the page. Robots with the same address share one page with a choice of the
        robot.
        """
        if not self.options.enabled:
            return
        http = host.feature("http", HttpFeature)
        admission = ViewAccess(
            tokens=TokenFiles(http.options.tokens, os.environ),
            rules=host_rules(self.options, http.options),
        )
        operator = ServerOperator(host, http.lease)
        with contextlib.suppress(RuntimeError):  # not called by a serving server
            operator.loop = from_thread.run_sync(asyncio.get_running_loop)
        self._shared = _SharedPage.join(
            self.options, host.config.namespace, self._source, admission, operator
        )
        self.viewer = self._shared.viewer

    def close(self) -> None:
        """Close the page. The first of the robots that share it closes it, because the server is
        closing.
        """
        if self._shared is not None:
            self._shared.close()


class _SharedPage:
    """Page of all robots of this process with the same configured address, which can be bound only
    once.
    """

    _in_use: ClassVar[dict[tuple[str, int], _SharedPage]] = {}
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, viewer: ViewServer, address: tuple[str, int]) -> None:
        self.viewer = viewer
        self._address = address

    @classmethod
    def join(
        cls,
        options: ViewOptions,
        name: str,
        source: ServerSource,
        admission: ViewAccess,
        operator: ServerOperator,
    ) -> _SharedPage:
        """Add a robot to the page at its address; creates the page for the first."""
        from rn_view.web.view_server import ViewServer  # heavy

        address = options.host, options.port
        with cls._lock:
            found = cls._in_use.get(address)
            if found is not None:
                found.viewer.join(name, source, operator)
                return found
            made = cls(ViewServer(options, {name: source}, admission, operator), address)
            made.viewer.open()
            cls._in_use[address] = made
            return made

    def close(self) -> None:
        """Close the page; idempotent."""
        with self._lock:
            if self._in_use.get(self._address) is self:
                del self._in_use[self._address]
        self.viewer.close()


def _main_camera(host: Host) -> Camera | None:
    cameras = load_profile(host.registry, host.config.robot).cameras
    if not cameras:
        return None
    from sensor_msgs.msg import Image  # heavy

    chosen = next((camera for camera in cameras if camera.role == "primary"), cameras[0])
    return partial(host.subscribe, Image, f"camera/{chosen.name}/image")


def _is_quiet(host: Host, name: str) -> bool:
    tool = host.tools.get(name)
    return tool is not None and (tool.read_only or name == HEARTBEAT)
