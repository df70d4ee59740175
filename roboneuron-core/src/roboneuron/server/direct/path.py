"""The direct path put together: what is exposed now, the gate in front of it, and the tools derived from it."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

from roboneuron.config import Config, ExposeConfig
from roboneuron.contract import RobotProfile
from roboneuron.errors import InvalidInputError, RefusedError, RoboNeuronError
from roboneuron.gate import AllowedEndpoint, AuditLog, AuditRecord, EmergencyStopLatch, Gate
from roboneuron.gate.audit import FILE_NAME as AUDIT_NAME
from roboneuron.modules.plugin import load_profile
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arm import arm_endpoints, arm_tools
from roboneuron.server.direct.derive import derive_tools
from roboneuron.server.direct.directory import directory_tools
from roboneuron.server.direct.discovery import LiveGraph
from roboneuron.server.direct.endpoints import Exposed, Exposure, exposure, unique
from roboneuron.server.direct.exposing import Admin, ExposureChange, exposing_tools
from roboneuron.server.direct.found import check_patterns
from roboneuron.server.direct.generic import generic_tools
from roboneuron.server.direct.kinematics import ArmPaths
from roboneuron.server.direct.motion import MotionDesk
from roboneuron.server.direct.parameter_calls import parameter_endpoints
from roboneuron.server.direct.parameters import parameter_tools
from roboneuron.server.direct.traffic import Traffic
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.registry import ToolRegistry
from roboneuron.server.tool import DerivedTool, Tool
from roboneuron.supervisor.supervisor import Supervisor

log = logging.getLogger(__name__)
_CLOSE_S = 2.0
Use = tuple[str, str, str]
"""Robot, label and kind of an endpoint."""


class DirectPath:
    """Derives tools into a registry, and again when the robot or the graph changes. Usable from any thread."""

    def __init__(self, loop: ClosedLoop, latch: EmergencyStopLatch, on_change: Callable[[], None]) -> None:
        """Args:
        loop: the closed loop beside it; its policy has the robot while it runs.
        latch: the emergency stop of the control plane.
        on_change: called, from any thread, when the listed tools changed.
        """
        self._loop = loop
        self._on_change = on_change
        self._lock = threading.Lock()
        self._registry: ToolRegistry | None = None
        supervisor: Supervisor = loop.supervisor
        config = loop.config
        self.gate = Gate(
            (),
            latch=latch,
            audit=AuditLog(supervisor.state_directory / AUDIT_NAME, time.time_ns),
            clock=time.monotonic,
            dry_run=config.direct.dry_run,
        )
        self.desk = MotionDesk(self.gate, self._policy)
        self.traffic = Traffic(lambda: supervisor.link)
        self._access = Access(
            gate=self.gate, desk=self.desk, traffic=self.traffic, max_duration_s=config.direct.max_duration_s
        )
        self._paths = ArmPaths(config, loop.plugins.current)
        self._exposure = Exposure()
        self._admin = threading.Lock()
        self._added: tuple[ExposeConfig, ...] = ()
        self._hidden: frozenset[Use] = frozenset()
        self._withdrawn: frozenset[tuple[str, str]] = frozenset()
        self._named: tuple[Exposed, ...] = ()
        self._found: tuple[Exposed, ...] = ()
        self._all: dict[str, DerivedTool] = {}
        self._graph = LiveGraph(config, self.traffic, lambda: self._named, self._profile, self._on_found)

    def tools(self, identifies_clients: bool) -> list[Tool[Any]]:
        """The tools that are there whatever is exposed; without tokens nobody exposes more unless it is configured."""
        config = self._loop.config
        tools = generic_tools(lambda: self._exposure, self.traffic)
        if identifies_clients or config.direct.expose_without_token:
            tools += exposing_tools(self, config.direct.expose_without_token)
        return tools

    def fill(self, registry: ToolRegistry) -> None:
        """Derive the tools of what the configuration exposes into `registry`.

        Raises:
            ConfigurationError, PluginError, MissingDependencyError: as `endpoints.exposure`.
        """
        self._registry = registry
        check_patterns(self._loop.config)
        self._derive(self._configured())

    def refresh(self) -> None:
        """The robot may have changed: derive again; a failure is logged and leaves the tools as they are."""
        try:
            if self._derive(self._configured()):
                self._on_change()
        except RoboNeuronError as error:
            log.error("The tools of the robot cannot be derived: %s", error)

    def expose(self, entry: ExposeConfig, admin: Admin) -> ExposureChange:
        """Expose one more endpoint until the server ends; blocks.

        Raises:
            ConfigurationError, PluginError, MissingDependencyError: as `endpoints.exposure`.
            RefusedError: the audit cannot be written.
        """
        robot = entry.robot or self._loop.config.robot.name
        with self._admin:
            shown = {u for u in self._hidden if u[0] == robot and entry.name in (None, u[1])
                     and entry.kind in (None, u[2])}  # fmt: skip
            return self._change((*self._added, entry), self._hidden - shown, admin)

    def unexpose(self, robot: str | None, name: str, kind: str | None, admin: Admin) -> ExposureChange:
        """Withdraw an endpoint, and end motion through it; blocks.

        Raises:
            InvalidInputError: there is none of that name.
            RefusedError: the audit cannot be written.
        """
        whose = robot or self._loop.config.robot.name
        with self._admin:
            uses = [*map(use_of, self._exposure.endpoints), *((n.robot, n.name, "parameters")
                    for n in self._exposure.nodes)]  # fmt: skip
            meant = {use for use in uses if use[:2] == (whose, name) and kind in (None, use[2])}
            if not meant:
                listed = ", ".join(sorted({use[1] for use in uses if use[0] == whose})[:20]) or "none"
                raise InvalidInputError(
                    f"No such endpoint {name!r} of {whose!r} is exposed; exposed are: {listed}.", path="name"
                )
            kept = tuple(e for e in self._added if not _is_about(e, whose, name, kind, self._loop.config))
            change = self._change(kept, self._hidden | meant, admin)
            self.desk.end_all(f"{name!r} was withdrawn.", _CLOSE_S, lambda exposed: use_of(exposed) in meant)
            return change

    def _change(self, added: tuple[ExposeConfig, ...], hidden: frozenset[Use], admin: Admin) -> ExposureChange:
        """Have another exposure: checked first, written down, then in force."""
        assert self._registry is not None
        record = AuditRecord(
            who=admin.who, role=admin.role, tool=admin.tool, arguments=admin.arguments, verdict="allowed"
        )
        before = (self._added, self._hidden)
        tools = {tool.name: (tool.input_schema, tool.description) for tool in self._registry.derived()}
        self._added, self._hidden = added, hidden
        try:
            configured = self._configured()
            self.gate.audit.write(record)
            is_new = self._derive(configured)
        except RoboNeuronError as error:
            self._added, self._hidden = before
            with suppress(RefusedError):
                self.gate.audit.write(replace(record, verdict="refused", reason=error.message[:500]))
            raise
        if is_new:
            self._on_change()
        now = {tool.name: (tool.input_schema, tool.description) for tool in self._registry.derived()}
        return ExposureChange(
            added=sorted(now.keys() - tools.keys()),
            removed=sorted(tools.keys() - now.keys()),
            changed=sorted(name for name in now.keys() & tools.keys() if now[name] != tools[name]),
        )

    def open(self) -> None:
        """Begin to watch the graph, where the configuration wants that."""
        self._graph.start()

    def close(self) -> None:
        """End every motion with its stop message; idempotent."""
        self._graph.stop()
        if not self.desk.end_all("The server is shutting down.", _CLOSE_S):
            log.error("A motion did not end within %g s.", _CLOSE_S)
        self.gate.audit.close()

    def _configured(self) -> Exposure:
        config: Config = self._loop.config
        made = exposure(config, self._loop.plugins.current(), self._added)
        self._withdrawn = frozenset((e.topic, e.endpoint.kind) for e in made.endpoints if use_of(e) in self._hidden)
        shown = Exposure(
            endpoints=tuple(e for e in made.endpoints if use_of(e) not in self._hidden),
            nodes=tuple(n for n in made.nodes if (n.robot, n.name, "parameters") not in self._hidden),
        )
        return replace(shown, endpoints=(*shown.endpoints, *arm_endpoints(config, shown)))

    def _derive(self, configured: Exposure) -> bool:
        """Allow list first, tools then: a tool is never there before its endpoint is allowed."""
        assert self._registry is not None
        with self._lock:
            self._named = configured.endpoints
            known = {*map(use_of, configured.endpoints), *self._hidden}
            # A pattern is no way around their limits, nor around an admin who withdrew a topic.
            used = {*self._withdrawn, *((e.topic, e.endpoint.kind) for e in configured.endpoints)}
            new = [e for e in self._found if use_of(e) not in known and (e.topic, e.endpoint.kind) not in used]
            endpoints = tuple(unique([*configured.endpoints, *new]))
            nodes = parameter_endpoints(configured.nodes)
            self.gate.replace([*map(self._allowed, endpoints), *(e.allowed() for e in nodes)])
            self._exposure = Exposure(endpoints=endpoints, nodes=configured.nodes)
            return self._registry.replace_derived(self._make(endpoints, configured))

    def _allowed(self, exposed: Exposed) -> AllowedEndpoint:
        """The entry of the allow list; joint motions of an arm with a TCP get the limits that actions have."""
        entry, profile = exposed.allowed(), exposed.profile
        if not exposed.endpoint.joint_limited or profile is None or not profile.tcp_link:
            return entry
        rules = self._paths.rules(exposed.robot, profile)
        return replace(entry, rules=rules, path=partial(self._paths.limiter, exposed.robot, profile))

    def _make(self, endpoints: Iterable[Exposed], configured: Exposure) -> list[DerivedTool]:
        config = self._loop.config
        assert self._registry is not None
        taken = {*self._registry.names(), "find_tools", "call_endpoint"}
        arm = arm_tools(endpoints, self._access, self._loop)
        settings = parameter_tools(configured.nodes, self._access)
        fixed = [*arm, *settings]
        hidden = {tool.name for tool in fixed}
        plain = [e for e in endpoints if not e.hidden]
        derived = derive_tools(plain, self._access, taken | hidden)
        self._all = {tool.name: tool for tool in (*fixed, *derived)}
        if len(derived) <= config.direct.listed_tools:
            return list(self._all.values())
        unlisted = [replace(tool, listed=False) for tool in derived]
        return [*fixed, *directory_tools(lambda: self._all), *unlisted]

    def _profile(self, robot: str) -> RobotProfile | None:
        registry = self._loop.plugins.current()
        return load_profile(registry, robot) if robot in registry.specs("robot") else None

    def _on_found(self, found: tuple[Exposed, ...]) -> None:
        self._found = found
        self.refresh()

    def _policy(self, exposed: Exposed) -> str:
        """Who else moves the robot, as a sentence."""
        view = self._loop.supervisor.view("inference")
        if view.phase not in ("starting", "running") or view.choice is None:
            return ""
        if view.choice.settings.config.namespace != exposed.namespace:
            return ""
        return f"The policy {view.choice.names.get('backend', '')!r} moves {exposed.robot!r}."


def use_of(exposed: Exposed) -> Use:
    """What an admin names: whose, which, for what."""
    return exposed.robot, exposed.label, exposed.endpoint.kind


def _is_about(entry: ExposeConfig, robot: str, name: str, kind: str | None, config: Config) -> bool:
    return (entry.robot or config.robot.name, entry.name) == (robot, name) and kind in (None, entry.kind)
