"""The closed loop as operated by an agent: select, start, steer, stop. Calls block; any thread may
call.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from roboneuron.config import Config, LimitsConfig
from roboneuron.errors import InternalError, StateError
from roboneuron.estop.emergency import EmergencyStop
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.modules.arm_paths import UncheckedPaths
from roboneuron.modules.settings import EMERGENCY_STOP, MODULE_KINDS, ModuleKind
from roboneuron.moved import Moved
from roboneuron.planning import KIND_ENTRIES, KindEntry, Plan
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import RobotSpec
from roboneuron.server.tool import Arguments
from roboneuron.supervisor.changes import Stage
from roboneuron.supervisor.health import Modules, ModuleView, Stopped
from roboneuron.supervisor.lifecycle import NodeClient
from roboneuron.supervisor.slot import Slot
from roboneuron.supervisor.supervisor import Supervisor

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink


_KEPT_ACTIONS = 4096


SentAction: TypeAlias = tuple[int, tuple[float, ...]]
"""DDS source time of an action [ns], set when inference sent it and independent of its transport;
and its values.
"""


def _listen(link: RosLink, namespace: str) -> deque[SentAction]:
    """Collect the newest actions of `/<namespace>/action`, oldest first, as long as the link is
    open; read a `copy`.
    """
    from std_msgs.msg import Float64MultiArray  # heavy

    from roboneuron.ros.qos import STATUS
    from roboneuron.ros.topics import ACTION

    # Many are kept: a busy control plane must not take its own delay for a missing action.
    actions: deque[SentAction] = deque(maxlen=_KEPT_ACTIONS)

    def receive(message: Any, info: dict[str, Any]) -> None:
        actions.append((int(info["source_timestamp"]), tuple(message.data)))

    topic = f"/{namespace}/{ACTION}"
    link.create(
        "subscription",
        topic,
        Float64MultiArray,
        lambda node: node.create_subscription(Float64MultiArray, topic, receive, STATUS),
    )
    return actions


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotFacts:
    """The running robot, or else the configured one; real unless its driver declares that it is
    simulated.
    """

    name: str
    driver: str
    kind: Literal["real", "simulated"]

    def __str__(self) -> str:
        return f"{self.kind} robot {self.name} (driver {self.driver})"


Choose = Callable[[ModuleKind, Config, Registry, Arguments, str], Plan]
"""Selects a client's request; called with kind, configuration, plugins, request and role; raises as
`KindEntry.check`. Only requests with arguments come to it: what is omitted is as configured.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class StartForm:
    """How clients ask for a module that is not started as configured; declared by
    `Feature.start_forms`.

    Attributes:
        kind: kind of the module.
        arguments: arguments of `start_<kind>`.
        plan: selects what a request asks for.
        choices: as `Tool.choices`, for these arguments.
    """

    kind: ModuleKind
    arguments: type[Arguments]
    plan: Choose
    choices: Mapping[str, Callable[[], dict[str, str]]] = field(default_factory=dict)


class ClosedLoop:
    """One robot and the modules around it.

    Args:
        config: the robot's configuration.
        plugins: returns the installed plugins, like `discover`.
        supervisor: supervisor of the modules.

    Attributes:
        forms: how clients ask for modules, by kind, see `accept`. What has no form is started as
            configured.
        on_stop: event before a module is stopped.
        starts: requests for motion, and the stops since.
        streams: actions sent on action topics, by namespace, see `stream`.
        modules: state of the module processes.
    """

    choose = Moved("Feature.start_forms")

    def __init__(
        self, config: Config, plugins: Callable[[], Registry], supervisor: Supervisor
    ) -> None:
        self.base = config
        self._plugins = plugins
        self._known: Registry | None = None
        self._unchecked = UncheckedPaths()
        self._supervisor = supervisor
        self.modules: Modules = supervisor
        self.emergency_stop = EmergencyStop(supervisor)
        self.starts = MotionStarts(supervisor)
        stop = self.emergency_stop.file
        stop.on_press.append(self.starts.claims.stop_now)
        stop.on_pressed.append(lambda: self.starts.note_stop(EMERGENCY_STOP))
        stop.on_pressed.append(self.starts.claims.wake)
        self.kinds: Mapping[ModuleKind, KindEntry] = KIND_ENTRIES
        self.forms: Mapping[ModuleKind, StartForm] = {}
        self.on_stop: Callable[[ModuleKind], object] = lambda kind: None
        self.streams: dict[str, deque[SentAction]] = {}
        self._lock = threading.Lock()

    @property
    def config(self) -> Config:
        """The configuration with the running robot, or the configured one."""
        running = self.modules.view("robot").plan
        others: dict[str, Any] = {
            kind: getattr(self.base, kind) for kind in (*MODULE_KINDS, "modules") if kind != "robot"
        }
        return self.base if running is None else running.config.model_copy(update=others)

    @property
    def registry(self) -> Registry:
        """The installed plugins; callable from any thread.

        Raises:
            ConfigurationError: the configuration disables a plugin that is not installed.
        """
        self._known = self._plugins()
        return self._known

    @property
    def limits(self) -> LimitsConfig:
        """The limits in force: those of the configuration, or tighter ones set by a client."""
        return self.modules.tightened or self.base.limits

    @property
    def robot_facts(self) -> RobotFacts:
        """Identify the running or configured robot, and whether it is real."""
        robot = self.config.robot
        registry = self._known or self.registry  # cached, because every answer of a tool needs it
        spec = registry.specs(RobotSpec).get(robot.name)
        driver = None if spec is None else spec.driver(robot.driver)
        kind: Literal["real", "simulated"] = (
            "simulated" if driver is not None and driver.simulated else "real"
        )
        return RobotFacts(name=robot.name, driver=robot.driver, kind=kind)

    @property
    def unchecked(self) -> str:
        """Why places or distances between the links of the present robot are not checked, and what
        to do; empty if they are.
        """
        reports = [self.modules.view(kind).report for kind in ("robot", "control")]
        metrics = [None if report is None else report.metrics for report in reports]
        return self._unchecked.why(self.config, self._known or self.registry, *metrics)

    def takes_policies(self) -> bool:
        """True if any policy could move the present robot; also for a robot whose plugin is
        missing.
        """
        spec = self.registry.specs(RobotSpec).get(self.config.robot.name)
        return spec is None or bool(spec.action_widths)

    def camera_roles(self) -> dict[str, str]:
        """Camera name -> role for the present robot; empty if its plugin is missing."""
        spec = self.registry.specs(RobotSpec).get(self.config.robot.name)
        return {} if spec is None else {camera.name: camera.role for camera in spec.cameras}

    def add_kinds(self, entries: Mapping[ModuleKind, KindEntry]) -> None:
        """Take the modules of kinds that features add too, while the server is assembled."""
        self.kinds = {**self.kinds, **entries}
        self._supervisor.add_kinds(entries)

    def accept(self, forms: Iterable[StartForm]) -> None:
        """Let clients ask for modules by these forms, while the server is assembled.

        Raises:
            InternalError: there is a form for one of the kinds already.
        """
        for form in forms:
            if form.kind in self.forms:
                raise InternalError(f"There are two forms for the start of {form.kind}.")
            self.forms = {**self.forms, form.kind: form}

    def select(self, kind: ModuleKind, request: Arguments | None, role: str = "") -> Plan:
        """Plan a client's request, or the configured module for one without arguments, checked
        against the installed plugins and the running modules.

        Nothing is changed.

        Raises:
            RoboNeuronError: as `StartForm.plan` and `check`.
        """
        config = self.base if kind == "robot" else self.config
        if request is None or not request.model_fields_set:
            plan = self.kinds[kind].check(config, self.registry)
        else:
            form = self.forms.get(kind)
            if form is None or not isinstance(request, form.arguments):
                raise InternalError(
                    f"This server cannot read the {type(request).__name__} that a client sent for "
                    f"{kind}."
                )
            plan = form.plan(kind, config, self.registry, request, role)
        self.check(plan)
        return plan

    def check(self, plan: Plan) -> None:
        """Refuse a plan that is incompatible with the running modules, or that could not move now.

        Raises:
            StateError: another module works for another robot.
            RefusedError: the emergency stop is latched, and a backend with an instruction needs an
                action to pass its readiness check.
            RoboNeuronError: as `Plan.check_beside` of a running module, or of this one.
        """
        views = self.modules.views()
        if plan.kind == "robot":
            _check_namespace(plan, views)
        running = {
            view.kind: view.plan
            for view in views
            if view.phase == "running" and view.plan is not None
        }
        running[plan.kind] = plan
        configs = {kind: one.config for kind, one in running.items()}
        for one in running.values():
            one.check_beside(configs)
        section = plan.config.inference
        if plan.kind == "inference" and section is not None and section.instruction:
            self.emergency_stop.check()

    def start(
        self,
        kind: ModuleKind,
        request: Arguments | None = None,
        on_stage: Stage = lambda stage: None,
        role: str = "",
        halt: threading.Event | None = None,
    ) -> ModuleView:
        """Start a module for a client with `role`; as configured without a request or arguments.

        Args:
            halt: set when the client cancels its call; nothing that was started is left then.

        Raises:
            RoboNeuronError: as `select` and `Supervisor.start`.
        """
        return self.start_selected(self.select(kind, request, role), on_stage, halt)

    def start_selected(
        self, plan: Plan, on_stage: Stage, halt: threading.Event | None = None
    ) -> ModuleView:
        """Start a plan returned by `select`. An instruction in it counts as a start of motion.
        Raises as `Supervisor.start`.
        """
        self.emergency_stop.prepare(plan.config.namespace)
        self.starts.look()
        self.starts.settle()
        kind, section, ticket = plan.kind, plan.config.inference, 0
        if kind == "inference" and self._supervisor.slot(kind).phase in ("stopped", "exited"):
            self.stream(plan.config.namespace)
            text = section.instruction if section is not None else ""
            if text:
                self.starts.permit()
            ticket = self.starts.begin(text)
        self._supervisor.start(plan, on_stage, halt=halt)
        if kind == "inference":
            self.starts.follow(self._supervisor.slot(kind), ticket)
        else:
            self.starts.arm_started()  # motion may have been requested during the start
        if halt is not None and halt.is_set():  # after the last check of the start itself
            with suppress(StateError):  # stopped by another client
                self.stop(kind)
            raise StateError(f"The start of {kind} was cancelled: its call was cancelled.")
        return self.modules.view(kind)

    def launch(
        self,
        plan: Plan,
        on_stage: Stage = lambda stage: None,
        beside: Slot | None = None,
        halt: threading.Event | None = None,
    ) -> None:
        """Start a process without a start of motion: again after its end, or in a slot beside the
        working module. Raises as `Supervisor.start`.
        """
        self._supervisor.start(plan, on_stage, beside, halt)

    def end(self, ended: Slot | ModuleKind) -> Stopped:
        """End the process in a slot, or the module of a kind and a start in progress, for a
        successor: no stop event is sent. Raises as `Supervisor.stop`.
        """
        if isinstance(ended, Slot):
            return self._supervisor.end(ended)
        return self._supervisor.stop(ended)

    def parameters(self, slot: Slot) -> NodeClient:
        """Parameters of the module in a slot. Raises StateError: its process has ended."""
        return self._supervisor.parameters(slot)

    def stream(self, namespace: str) -> deque[SentAction]:
        """Actions sent on a robot's action topic since a backend was first started for it."""
        with self._lock:
            if namespace not in self.streams:
                self.streams[namespace] = _listen(self._supervisor.link, namespace)
            return self.streams[namespace]

    def stop(self, kind: ModuleKind) -> Stopped:
        """Stop one module. Raises as `Supervisor.stop`."""
        self.on_stop(kind)
        try:
            return self._supervisor.stop(kind)
        finally:
            self.starts.stop(kind, f"{kind} was stopped", is_asked=True)

    def stop_all(self) -> list[Stopped]:
        """Stop everything, in the reverse order of starting."""
        for kind in self.kinds:
            self.on_stop(kind)
        try:
            return self._supervisor.stop_all()
        finally:
            self.starts.stop("robot", "everything was stopped", is_asked=True)

    def set_parameters(
        self,
        kind: ModuleKind,
        values: Mapping[str, str | int],
        timeout_s: float,
        start_s: float = 0.0,
    ) -> str:
        """Set parameters of all running modules of a kind, a successor included.

        Args:
            kind: kind of the modules.
            values: values by parameter name.
            timeout_s: bound on the answer of each.
            start_s: longest wait for the end of a start in progress.

        Returns:
            The reason of the first refusal; empty if all accepted.

        Raises:
            RoboNeuronError: one does not answer.
        """
        with self.modules.changes.lock:
            slots = tuple(self.modules.slots[kind])
        for slot in slots:
            slot.await_settled(start_s)
            if slot.phase != "running" or slot.process is None:
                continue
            if refused := self.parameters(slot).set(values, timeout_s):
                return refused
        return ""


def _check_namespace(robot: Plan, views: Iterable[ModuleView]) -> None:
    for view in views:
        if view.plan is not None and view.plan.config.namespace != robot.config.namespace:
            raise StateError(
                f"{view.kind} works for the robot in /{view.plan.config.namespace}, "
                f"not for {robot.config.robot.name!r}.",
                hint="Call stop_all first.",
            )
