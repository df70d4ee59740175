"""Several robots in one server process: an application for each, one MCP server in front of all.

Each robot has its own supervisor, gate, limits, leases, emergency stop, audit and incidents, in its
own folder. The process has one ROS node, transport, SIGUSR1 handler and shutdown.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_standard.fleet.connection import PARTICIPANTS, SharedConnection, participants_of
from rn_standard.fleet.fleet_tools import emergency_stop_tool, list_fleet_tool, stop_motion_tool
from rn_standard.fleet.tools import FleetTools
from roboneuron import ConfigurationError, Resource, RoboNeuronError, Tool, Transport, UnsafeError
from roboneuron.feature import (
    Application,
    Config,
    Events,
    Periodic,
    Registry,
    estop,
    log_files,
    make_server,
    reading,
)

if TYPE_CHECKING:
    from roboneuron.feature import Application


def uri_of(robot: str, uri: str) -> str:
    """URI of a robot's resource in a server of several robots."""
    scheme, _, rest = uri.partition("://")
    return f"{scheme}://{robot}/{rest}"


def resources_of(robots: Mapping[str, Application]) -> dict[str, Resource]:
    """The resources of all robots by URI."""
    found = [
        replace(
            resource,
            uri=uri_of(name, resource.uri),
            name=f"{name}: {resource.name}",
            title=f"{name}: {resource.title}",
        )
        for name, robot in robots.items()
        for resource in robot.resources.values()
    ]
    return {resource.uri: resource for resource in found}


log = logging.getLogger(__name__)
NAMESPACE_FILE = "namespace"
"""File in a robot's folder with its ROS namespace, for `roboneuron status`, which has no
configuration.
"""
_LOOK_S = 0.02
"""Period of checking the common latch, equal to that of the modules."""


class Fleet:
    """All parts of `roboneuron serve` for several robots; implements
    `roboneuron.server.surface.Served`.

    Args:
        config: configuration with `robots`.
        state: the state directory; each robot has a folder in it.
        plugins, command: replacements for tests.

    Attributes:
        robots: the application of each robot by its name.
        events: `tools` and `resource` of all robots, and `client`.
    """

    def __init__(
        self,
        config: Config,
        state: Path,
        *,
        plugins: Callable[[], Registry] | None = None,
        command: Callable[[str | None], Sequence[str]] | None = None,
    ) -> None:
        logs = state / "log" / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}"
        self._state = state
        self._connection = SharedConnection(logs)
        self._latch = estop.EmergencyStopLatch.in_directory(state)
        self._was_latched = False
        self._watch = Periodic("fleet-latch", _LOOK_S, self._look)
        self._threads = ThreadPoolExecutor(
            max_workers=len(config.robots), thread_name_prefix="fleet"
        )
        self.robots: dict[str, Application] = {}
        self.events = Events()
        try:
            for name, one in config.robots.items():
                self.robots[name] = self._application(
                    name, one, reading.robot_folder(state, name), plugins, command
                )
        except BaseException:
            self.close()
            raise
        own: list[Tool] = [
            list_fleet_tool(self.robots),
            emergency_stop_tool(self),
            stop_motion_tool(self.robots),
        ]
        self.tools = FleetTools(self.robots, own, lambda who: self.events.client.tell(who, True))
        self.tools.chain.press_first(self.press)
        self.resources = resources_of(self.robots)
        named = ", ".join(
            f"{name} ({robot.loop.robot_facts})" for name, robot in self.robots.items()
        )
        tools = {name for robot in self.robots.values() for name in robot.tools.names()}
        robots = (
            f"RoboNeuron operates {len(self.robots)} robots: {named}. Every tool takes `robot`, "
            "the one it is about; "
            "list_fleet shows how they are; without `robot`, emergency_stop and stop_motion stop "
            "all."
        )
        first = next(iter(self.robots.values()))
        # those of the first robot ask the client's user, which is independent of the robot
        self.features = first.features
        self.server = make_server(self, config.server.name)
        self.server.introduce(robots, tools)
        self._host = replace(
            first.host,
            server=self.server,
            events=self.events,
        )
        first.features.each("attached", lambda feature: feature.attach(self._host))

    def check(self) -> None:
        """Check the configuration of each robot.

        Raises:
            ConfigurationError: names the robot.
        """
        for name, robot in self.robots.items():
            try:
                robot.check()
            except RoboNeuronError as error:
                raise ConfigurationError(
                    f"[robots.{name}]: {error.message}", hint=error.hint
                ) from error

    @property
    def omitted(self) -> list[str]:
        """What of the configuration is left out, a sentence each, with the robot."""
        return [
            f"[robots.{name}]: {reason}"
            for name, robot in self.robots.items()
            for reason in robot.omitted
        ]

    def listen(self, wire: tuple[int, int]) -> Transport:
        """Start listening for the clients of all robots; for `wire` see `Host`."""
        return self.features.listen(replace(self._host, wire=wire))

    def open(self) -> None:
        """Start joining the ROS graph, and watching the common latch, which stops all robots."""
        self._note_namespaces()
        wanted, given = (
            participants_of(r.loop.config for r in self.robots.values()),
            os.environ.get(PARTICIPANTS, ""),
        )
        os.environ[PARTICIPANTS] = str(max(wanted, int(given) if given.isdecimal() else 0))
        for robot in self.robots.values():
            robot.open()
        self._look()
        self._watch.start()

    async def settle(self) -> None:
        """See Application."""
        for robot in self.robots.values():
            await robot.settle()

    def press(self, who: str, reason: str) -> None:
        """Latch the emergency stop of all robots without waiting; `latch` reports failures."""
        estop.EmergencyStopLatch.press_together(
            [robot.loop.emergency_stop.file for robot in self.robots.values()],
            who=who,
            reason=reason,
        )

    def latch(self, who: str, reason: str = "") -> tuple[list[str], float]:
        """Stop all motion of all robots; return the modules that confirmed it, and the time that
        took [s].

        Raises:
            UnsafeError: a robot's modules did not confirm it, or its latch cannot be written; all
                others were stopped nevertheless.
        """
        started_s = time.monotonic()
        self.press(who, reason)

        def latch_one(name: str) -> tuple[list[str], str]:
            robot = self.robots[name]
            try:
                confirmed, _ = robot.loop.emergency_stop.latch(
                    robot.loop.config.namespace, who=who, reason=reason
                )
            except RoboNeuronError as error:
                return [], f"{name}: {error}"
            return [f"{name}/{kind}" for kind in confirmed], ""

        done = list(self._threads.map(latch_one, self.robots))
        failures = [failure for _, failure in done if failure]
        if failures:
            raise UnsafeError("\n".join(failures))
        return [
            module for confirmed, _ in done for module in confirmed
        ], time.monotonic() - started_s

    def close(self) -> None:
        """Stop all motion, modules and threads of all robots in parallel; idempotent."""
        self._watch.close()
        with ThreadPoolExecutor(
            max_workers=max(1, len(self.robots)), thread_name_prefix="close"
        ) as closing:
            for name, closed in [
                (name, closing.submit(robot.close)) for name, robot in self.robots.items()
            ]:
                try:
                    closed.result()
                except Exception:  # one robot that cannot be closed must not block the others
                    log.exception("The robot %r could not be closed.", name)
        self._threads.shutdown(wait=False)
        self._connection.end()

    def _application(
        self,
        name: str,
        config: Config,
        folder: Path,
        plugins: Callable[[], Registry] | None,
        command: Callable[[str | None], Sequence[str]] | None,
    ) -> Application:
        made = Application(
            config,
            directory=folder,
            plugins=plugins,
            command=command,
            connect=self._connection.of_robot(config.namespace),
            attached=False,
        )
        made.events.tools.listen(self.events.tools.tell)
        made.events.resource.listen(lambda uri: self.events.resource.tell(uri_of(name, uri)))
        self.events.client.listen(made.events.client.tell)
        self.events.presence.listen(made.events.presence.tell)
        return made

    def _note_namespaces(self) -> None:
        for name, robot in self.robots.items():
            folder = reading.robot_folder(self._state, name)
            path = folder / NAMESPACE_FILE
            with open(path, "w", encoding="utf-8", opener=log_files.opener) as file:
                file.write(robot.loop.config.namespace)

    def _look(self) -> None:
        """Check the common latch, written by `roboneuron estop`: each robot is then stopped until
        it is reset itself.
        """
        is_latched = self._latch.is_latched()
        if is_latched and not self._was_latched:
            state = self._latch.read_state()
            self.press(state.who or "the state directory", state.reason)
        self._was_latched = is_latched
