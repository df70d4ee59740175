"""The feature: the present exposure, and the tools derived from it."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

from roboneuron.config.models import Config
from roboneuron.contract import RobotProfile
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.gate.audit import AuditRecord
from roboneuron.modules.plugin import load_profile
from roboneuron.plugins.specs import RobotSpec
from roboneuron.server.feature import Feature
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint
from roboneuron.server.tool import Tool
from roboneuron.tools.ros.derive import derive_tools
from roboneuron.tools.ros.discovered_limits import check_patterns
from roboneuron.tools.ros.discovery import LiveGraph
from roboneuron.tools.ros.exposing import Admin, ExposureChange, exposing_tools
from roboneuron.tools.ros.exposure import Exposure, exposure, unique
from roboneuron.tools.ros.generic import generic_tools
from roboneuron.tools.ros.graph import GraphNames
from roboneuron.tools.ros.options import ExposeConfig, RosToolsOptions
from roboneuron.tools.ros.parameter_calls import parameter_endpoints
from roboneuron.tools.ros.parameters import parameter_tools
from roboneuron.tools.ros.plugin import FEATURE

log = logging.getLogger(__name__)
_END_S = 2.0
Use = tuple[str, str, str]
"""Robot, label and kind of an endpoint."""


class RosTools(Feature[RosToolsOptions]):
    """Derives the tools, again whenever the robot, the graph or an admin changes the exposure.
    Usable from any thread.

    Attributes:
        exposed: the present exposure.
    """

    def __init__(self, options: RosToolsOptions) -> None:
        super().__init__(options)
        self.exposed = Exposure()
        self._host: Host
        self._graph: LiveGraph | None = None
        # allow list and tools change together: discovery derives them too, on its own thread
        self._lock = threading.Lock()
        # one change by an admin at a time, its audit included; taken before the other lock
        self._admin = threading.Lock()
        self._added: tuple[ExposeConfig, ...] = ()
        self._hidden: frozenset[Use] = frozenset()
        self._withdrawn: frozenset[tuple[str, str]] = frozenset()
        self._named: tuple[ExposedEndpoint, ...] = ()
        self._discovered: tuple[ExposedEndpoint, ...] = ()
        self._omitted: tuple[str, ...] = ()

    @property
    def omitted(self) -> tuple[str, ...]:
        """Endpoints whose type cannot be used."""
        return self._omitted

    def tools(self, host: Host) -> Sequence[Tool]:
        """Return the permanent tools; the derived ones are added to them.

        Raises:
            ConfigurationError, PluginError, MissingDependencyError: as `exposure`.
        """
        self._host = host
        check_patterns(self.options.discover)
        tools = generic_tools(lambda: self.exposed, GraphNames(host))
        if host.identifies_clients or self.options.direct.expose_without_token:
            tools += exposing_tools(self, self.options.direct.expose_without_token)
        self._derive(self._configured(), taken={tool.name for tool in tools})
        host.events.change.listen(self._on_module)
        return tools

    def start(self, host: Host) -> None:
        """Start monitoring the graph, if configured."""
        self._graph = LiveGraph(
            self.options.discover,
            host.config,
            GraphNames(host),
            lambda: self._named,
            self._profile,
            self._on_discovered,
        )
        self._graph.start()

    def close(self) -> None:
        """Stop monitoring the graph; idempotent."""
        if self._graph is not None:
            self._graph.stop()

    def refresh(self) -> None:
        """Derive the tools again, because the robot may have changed; a failure is logged and keeps
        the present tools.
        """
        try:
            self._derive(self._configured())
        except RoboNeuronError as error:
            log.error("The tools of the robot cannot be derived: %s", error)

    def expose(self, entry: ExposeConfig, admin: Admin) -> ExposureChange:
        """Expose one more endpoint until the server ends; blocks.

        Raises:
            ConfigurationError, PluginError, MissingDependencyError: as `endpoints.exposure`.
            RefusedError: the audit cannot be written.
        """
        robot = entry.robot or self._host.config.robot.name
        with self._admin:
            shown = {u for u in self._hidden if u[0] == robot and entry.name in (None, u[1])
                     and entry.kind in (None, u[2])}  # fmt: skip
            return self._change((*self._added, entry), self._hidden - shown, admin)

    def unexpose(
        self, robot: str | None, name: str, kind: str | None, admin: Admin
    ) -> ExposureChange:
        """Withdraw an endpoint, and end motion through it; blocks.

        Raises:
            InvalidInputError: there is none of that name.
            RefusedError: the audit cannot be written.
        """
        whose = robot or self._host.config.robot.name
        with self._admin:
            uses = [*map(use_of, self.exposed.endpoints), *((n.robot, n.name, "parameters")
                    for n in self.exposed.nodes)]  # fmt: skip
            meant = {use for use in uses if use[:2] == (whose, name) and kind in (None, use[2])}
            if not meant:
                listed = (
                    ", ".join(sorted({use[1] for use in uses if use[0] == whose})[:20]) or "none"
                )
                raise InvalidInputError(
                    f"No such endpoint {name!r} of {whose!r} is exposed; exposed are: {listed}.",
                    path="name",
                )
            kept = tuple(
                e for e in self._added if not _is_about(e, whose, name, kind, self._host.config)
            )
            change = self._change(kept, self._hidden | meant, admin)
            self._host.gate.end_motions(
                f"{name!r} was withdrawn.", _END_S, lambda exposed: use_of(exposed) in meant
            )
            return change

    def _change(
        self, added: tuple[ExposeConfig, ...], hidden: frozenset[Use], admin: Admin
    ) -> ExposureChange:
        """Apply another exposure: check it, audit it, then put it in force."""
        record = AuditRecord(
            who=admin.who,
            role=admin.role,
            tool=admin.tool,
            arguments=admin.arguments,
            verdict="allowed",
        )
        before = (self._added, self._hidden)
        tools = {
            tool.name: (tool.input_schema(), tool.description)
            for tool in self._host.tools.derived(FEATURE.name)
        }
        self._added, self._hidden = added, hidden
        try:
            configured = self._configured()
            self._host.audit.write(record)
            self._derive(configured)
        except RoboNeuronError as error:
            self._added, self._hidden = before
            with suppress(RefusedError):
                self._host.audit.write(
                    replace(record, verdict="refused", reason=error.message[:500])
                )
            raise
        now = {
            tool.name: (tool.input_schema(), tool.description)
            for tool in self._host.tools.derived(FEATURE.name)
        }
        return ExposureChange(
            added=sorted(now.keys() - tools.keys()),
            removed=sorted(tools.keys() - now.keys()),
            changed=sorted(name for name in now.keys() & tools.keys() if now[name] != tools[name]),
        )

    def _configured(self) -> Exposure:
        config: Config = self._host.config
        made = exposure(config, self.options, self._host.registry, self._added)
        self._withdrawn = frozenset(
            (e.topic, e.endpoint.kind) for e in made.endpoints if use_of(e) in self._hidden
        )
        for reason in sorted({*made.omitted} - {*self._omitted}):
            log.error("Left out: %s", reason)
        self._omitted = made.omitted
        return Exposure(
            endpoints=tuple(e for e in made.endpoints if use_of(e) not in self._hidden),
            nodes=tuple(
                n for n in made.nodes if (n.robot, n.name, "parameters") not in self._hidden
            ),
        )

    def _derive(self, configured: Exposure, taken: Iterable[str] = ()) -> None:
        """Set the allow list first, then the tools: no tool exists before its endpoint is
        allowed.
        """
        with self._lock:
            self._named = configured.endpoints
            known = {*map(use_of, configured.endpoints), *self._hidden}
            # A pattern must not circumvent their limits, nor an admin's withdrawal of a topic.
            used = {*self._withdrawn, *((e.topic, e.endpoint.kind) for e in configured.endpoints)}
            new = [
                e
                for e in self._discovered
                if use_of(e) not in known and (e.topic, e.endpoint.kind) not in used
            ]
            endpoints = tuple(unique([*configured.endpoints, *new]))
            nodes = parameter_endpoints(configured.nodes)
            self._host.gate.expose(FEATURE.name, [*endpoints, *nodes], instead_of_profile=True)
            self.exposed = Exposure(endpoints=endpoints, nodes=configured.nodes)
            self._host.tools.replace_derived(FEATURE.name, self._make(endpoints, configured, taken))

    def _make(
        self, endpoints: Iterable[ExposedEndpoint], configured: Exposure, taken: Iterable[str]
    ) -> list[Tool]:
        settings = parameter_tools(configured.nodes, self._host.gate)
        names = {
            *self._host.tools.names(besides=FEATURE.name),
            *taken,
            *(tool.name for tool in settings),
        }
        derived = derive_tools(endpoints, self._host, names)
        if len(derived) <= self.options.direct.listed_tools:
            return [*settings, *derived]
        return [*settings, *(replace(tool, listed=False) for tool in derived)]

    def _profile(self, robot: str) -> RobotProfile | None:
        registry = self._host.registry
        return load_profile(registry, robot) if robot in registry.specs(RobotSpec) else None

    def _on_discovered(self, discovered: tuple[ExposedEndpoint, ...]) -> None:
        self._discovered = discovered
        self.refresh()

    def _on_module(self, kind: str) -> None:
        """Derive again, because another robot has other interfaces."""
        if kind == "robot":
            self.refresh()


def use_of(exposed: ExposedEndpoint) -> Use:
    """Identify an endpoint as an admin does: robot, name, kind."""
    return exposed.robot, exposed.label, exposed.endpoint.kind


def _is_about(entry: ExposeConfig, robot: str, name: str, kind: str | None, config: Config) -> bool:
    return (entry.robot or config.robot.name, entry.name) == (robot, name) and kind in (
        None,
        entry.kind,
    )
