"""Assembly of the server: tools and resources over one closed loop, served over stdio or the
transport of a feature.
"""

from __future__ import annotations

import gc
import logging
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

import anyio
from anyio import to_thread

from roboneuron.config import Config, fleet_feature, transport_feature
from roboneuron.errors import ConfigurationError, RoboNeuronError, StateError
from roboneuron.estop.emergency import press_on_signal
from roboneuron.hang_watch import HangWatch
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.registry import Registry
from roboneuron.ros.environment import state_directory
from roboneuron.server.feature import Features
from roboneuron.server.host import Events, Host
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.registry import ToolRegistry
from roboneuron.server.stop_tools import emergency_tool, stop_tools
from roboneuron.server.surface import Served, make_server
from roboneuron.server.tool import Resource, Transport
from roboneuron.server.tool_search import search_tools
from roboneuron.supervisor.connection import Connect, Connection
from roboneuron.supervisor.health import Watch
from roboneuron.supervisor.process import Command, module_command
from roboneuron.supervisor.supervisor import LEAVE_S, Supervisor

SWITCH_S = 0.001
"""Interpreter switch interval: bounds how long a computing thread blocks the others; the default is
5 ms.
"""


def shorten_pauses() -> None:
    """Exempt all present objects from garbage collection; call it once everything is imported and
    derived.

    A full collection visits every object and stops all threads: 80 to 130 ms with ROS, MCP and 3 to
    1,000 endpoints loaded. The present objects live until the end, so later collections skip them.
    No collection runs now, since a client waits for its first call; it would free 9,000 of 146,000
    objects.
    """
    sys.setswitchinterval(SWITCH_S)
    gc.freeze()
    gc.enable()  # off since the start, see cli/serve.py


log = logging.getLogger(__name__)
_MOTION_S = 2.0


class Application:
    """All parts of `roboneuron serve` for one robot; `close` ends all of them.

    Args:
        config: the robot's configuration.
        plugins: plugins instead of the installed ones.
        directory: state directory instead of the configured one.
        command: command line of a module for a given interpreter; None for the default.
        connect: creates the server's node, see `Supervisor`.
        attached: clients connect to `server`; False for one of several robots.
    """

    def __init__(
        self,
        config: Config,
        *,
        plugins: Callable[[], Registry] | None = None,
        directory: Path | None = None,
        command: Command | None = None,
        connect: Connect = Connection,
        attached: bool = True,
    ) -> None:
        if config.robots:
            raise ConfigurationError(
                "This works with one robot; the configuration has [robots.<name>]."
            )
        self._joining = anyio.Lock()
        self.events = Events()
        self.supervisor = Supervisor(
            directory or state_directory(config.supervisor.state_directory),
            command=command or module_command,
            connect=connect,
        )
        self.supervisor.on_change = self.events.change.tell
        self.loop = ClosedLoop(
            config,
            plugins or partial(discover, config.disabled_plugins, config.robot),
            self.supervisor,
        )
        self.loop.on_stop = self.events.stop.tell
        self.loop.emergency_stop.audit.on_record = self.events.decision.tell
        self.features = Features(config, self.loop.registry)
        self.loop.add_kinds(self.features.kinds)
        self.supervisor.on_join = self.features.on_join
        self._watch = Watch(
            lambda: self.loop.starts.look(self.loop.emergency_stop.follow_file()),
            self.events.health.tell,
            self.events.fault.tell,
        )
        self.tools = ToolRegistry(
            [*stop_tools(self.loop, self._motions), emergency_tool(self.loop)],
            most_calls=config.server.max_concurrent_calls,
            on_begin=self.events.call_begun.tell,
            on_end=self.events.call_ended.tell,
            on_change=self.events.tools.tell,
            acts_on=lambda: str(self.loop.robot_facts),
        )
        self.tools.add_all(search_tools(self.tools.hidden))
        self.tools.chain.press_first(self.loop.emergency_stop.file.press)
        self.server = make_server(self, config.server.name)
        self.host = Host(
            loop=self.loop,
            audit=self.loop.emergency_stop.audit,
            server=self.server,
            features=self.features,
            tools=self.tools,
            events=self.events,
            started_s=time.monotonic(),
            state_directory=self.supervisor.state_directory,
            end_motion=self.end_motion,
            _link=lambda: self.supervisor.link,
        )
        offered = self.features.offer(self.host, self.tools)
        # without a gate nothing is sent for agents; with two the server does not start
        with suppress(StateError):
            self.host.gate  # noqa: B018
        self.server.introduce(
            f"RoboNeuron operates one {self.loop.robot_facts}.", self.tools.names()
        )
        self.resources: Mapping[str, Resource] = {resource.uri: resource for resource in offered}
        if attached:
            self.features.each("attached", lambda feature: feature.attach(self.host))

    def _motions(self) -> Sequence[str]:
        return self.host.motions

    def check(self) -> None:
        """Check the configuration against the installed plugins.

        Raises:
            ConfigurationError, PlanningError: it does not fit them.
        """
        check_configuration(self.loop.base, self.loop.registry)
        transport_feature(self.loop.base.server.transport, self.loop.registry)
        self.features.each("used", lambda feature: feature.check(self.loop.base))

    @property
    def omitted(self) -> list[str]:
        """What of the configuration is left out, a sentence each."""
        return self.features.omitted

    def listen(self, wire: tuple[int, int]) -> Transport:
        """Start listening for clients; for `wire` see `Host`."""
        return self.features.listen(replace(self.host, wire=wire))

    def latch(self, who: str) -> object:
        """Stop all motion, on behalf of `who`; raises as `EmergencyStop.latch`."""
        return self.loop.emergency_stop.latch(self.loop.config.namespace, who=who, reason="")

    def close(self) -> None:
        """Stop all motion, modules and threads; idempotent. The order is: motions of features,
        modules, features.
        """
        self._watch.close()
        if not self.end_direct_motion("The server is shutting down.", _MOTION_S):
            log.error("A motion did not end within %g s.", _MOTION_S)
        self.host.audit.close()
        self.supervisor.stop_all(LEAVE_S)
        self.features.close()
        self.supervisor.close()
        self.loop.emergency_stop.file.release()
        self.events.end.tell()

    def end_direct_motion(self, reason: str, timeout_s: float) -> bool:
        """End all motions of features outside the closed loop; return True if they ended in time.
        Idempotent.
        """
        deadline_s = time.monotonic() + timeout_s
        ended = True
        for name, feature in self.features.loaded.items():
            try:
                ended &= feature.end_motion(reason, max(0.0, deadline_s - time.monotonic()))
            except Exception:  # the border to a plugin's own code; the others end theirs
                log.exception("The feature %r could not end its motions.", name)
                ended = False
        return ended

    def open(self) -> None:
        """Start joining and monitoring the ROS graph in the background."""
        self.loop.emergency_stop.file.reserve()
        self.supervisor.open()
        self.events.open.tell()
        self.tools.chain.ready = self._join_ros
        self._watch.start()

    async def _join_ros(self) -> None:
        """Wait until the background thread has imported rclpy: a second thread that imports it
        meanwhile would get a half-initialised module.

        Features start afterwards. If ROS cannot be joined, the tools that need it report the
        reason.
        """
        async with self._joining:
            if self.tools.chain.ready is not None:
                with suppress(RoboNeuronError):
                    await to_thread.run_sync(lambda: self.supervisor.link)
                await to_thread.run_sync(self.features.start, self.host)
                self.tools.chain.ready = None  # no later call waits for the lock

    async def settle(self) -> None:
        """Subscribe to emergency stops of other nodes once ROS is joined, and call
        `shorten_pauses`.
        """
        await self._join_ros()
        with suppress(RoboNeuronError):  # reported by the tools that need ROS
            await to_thread.run_sync(self.loop.emergency_stop.prepare, self.loop.config.namespace)
        await to_thread.run_sync(shorten_pauses)

    def end_motion(self, reason: str, timeout_s: float) -> None:
        """End the policy and all direct motion, because the robot is unattended."""
        self.end_direct_motion(reason, timeout_s)
        with suppress(StateError):
            self.loop.stop("inference")


def make_served(config: Config) -> Served:
    """Create the server for a configuration: an Application for one robot, the object of a feature
    for several.

    Raises:
        ConfigurationError: no feature serves several robots.
    """
    if not config.robots:
        return Application(config)
    spec = fleet_feature(discover(config.disabled_plugins))
    make = cast(
        "Callable[[Config, Path], Served]",
        load_attribute(spec.fleet or "", f"feature {spec.name!r}"),
    )
    return make(config, state_directory(config.supervisor.state_directory))


def serve(config: Config, wire: tuple[int, int], watch: HangWatch | None = None) -> None:
    """Serve clients until the last one disconnects for good, or SIGTERM or SIGINT arrives; then
    stop everything.

    Args:
        config: names the transport.
        wire: see `Host`.
        watch: watch of this process; None for none.

    Raises:
        ConfigurationError, PlanningError: the configuration names something that is not installed
            or does not fit, or the transport cannot be served (an address in use, a missing token).
    """
    served = make_served(config)
    try:
        served.check()
        transport = served.listen(wire)
        press_on_signal(served.latch)
        loading = ExitStack()
        loading.enter_context((watch or HangWatch()).loading())  # joins the graph, starts features
        served.open()
        anyio.run(_serve, served, transport, loading.close)
    finally:
        Host.end_soon()
        served.close()


async def _serve(served: Served, transport: Transport, loaded: Callable[[], object]) -> None:
    leave = anyio.Event()

    async def leave_on_signal() -> None:
        with anyio.open_signal_receiver(signal.SIGTERM, signal.SIGINT) as signals:
            async for number in signals:
                log.info("Received %s: stopping everything.", signal.Signals(number).name)
                leave.set()
                return

    async def settle() -> None:
        try:
            await served.settle()
        finally:
            loaded()

    async with anyio.create_task_group() as group:
        group.start_soon(leave_on_signal)
        group.start_soon(settle)
        await transport(leave)
        group.cancel_scope.cancel()
