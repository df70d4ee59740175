"""The closed loop as the agent operates it: choose, start, steer, stop. Calls block; any thread may
call.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from roboneuron.config import Config, LimitsConfig
from roboneuron.errors import InternalError, StateError
from roboneuron.estop.emergency import EmergencyStop
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.modules.settings import EMERGENCY_STOP, MODULE_KINDS, ModuleKind
from roboneuron.planning import KIND_ENTRIES, Plan
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
"""DDS source time of an action [ns], when inference sent it, whatever the way to here took; and its
values.
"""


def _listen(link: RosLink, namespace: str) -> deque[SentAction]:
    """The newest actions of `/<namespace>/action`, oldest first, for as long as the link is open;
    read a `copy`.
    """
    from std_msgs.msg import Float64MultiArray  # heavy

    from roboneuron.ros.qos import STATUS
    from roboneuron.ros.topics import ACTION

    # Many are kept in between: a busy control plane must not mistake its own delay for a missing
    # action.
    actions: deque[SentAction] = deque(maxlen=_KEPT_ACTIONS)

    def receive(message: Any, info: dict[str, Any]) -> None:
        actions.append((int(info["source_timestamp"]), tuple(message.data)))

    topic = f"/{namespace}/{ACTION}"
    link.on_executor(
        lambda: link.node.create_subscription(Float64MultiArray, topic, receive, STATUS)
    )
    return actions


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotFacts:
    """The robot that runs, or else the one that the configuration names; real unless its driver
    declares that it is simulated.
    """

    name: str
    driver: str
    kind: Literal["real", "simulated"]

    def __str__(self) -> str:
        return f"{self.kind} robot {self.name} (driver {self.driver})"


Choose = Callable[[ModuleKind, Config, Registry, Arguments | None, str], Plan]
"""Selects what a client asks for; called with kind, configuration, plugins, request and role;
raises as `KindEntry.check`.
"""


def choose_configured(
    kind: ModuleKind, config: Config, registry: Registry, request: Arguments | None, role: str
) -> Plan:
    """What is configured, whatever the role."""
    if request is not None:
        raise InternalError(
            f"This server cannot read the {type(request).__name__} that a client sent for {kind}."
        )
    return KIND_ENTRIES[kind].check(config, registry)


class ClosedLoop:
    """One robot and the modules around it.

    Args:
        config: of the robot.
        plugins: tells what is installed now, as `discover`.
        supervisor: of the modules.

    Attributes:
        choose: selects what a client asks for; a feature that lets clients choose more puts its own
            here.
        on_stop: told of a module before it is stopped.
        starts: who has asked for motion, and the stops since.
        streams: what was sent on action topics, by namespace, see `stream`.
        modules: what is known of the module processes.
    """

    def __init__(
        self, config: Config, plugins: Callable[[], Registry], supervisor: Supervisor
    ) -> None:
        self.base = config
        self._plugins = plugins
        self._known: Registry | None = None
        self._supervisor = supervisor
        self.modules: Modules = supervisor
        self.emergency_stop = EmergencyStop(supervisor)
        self.starts = MotionStarts(supervisor)
        self.emergency_stop.file.on_pressed.append(lambda: self.starts.note_stop(EMERGENCY_STOP))
        self.choose: Choose = choose_configured
        self.on_stop: Callable[[ModuleKind], object] = lambda kind: None
        self.streams: dict[str, deque[SentAction]] = {}
        self._lock = threading.Lock()

    @property
    def config(self) -> Config:
        """The configuration with the robot that is running, or the configured one."""
        running = self.modules.view("robot").plan
        others: dict[str, Any] = {
            kind: getattr(self.base, kind) for kind in MODULE_KINDS if kind != "robot"
        }
        return self.base if running is None else running.config.model_copy(update=others)

    @property
    def registry(self) -> Registry:
        """What is installed now; callable from any thread.

        Raises:
            ConfigurationError: the configuration disables a plugin that is not installed.
        """
        self._known = self._plugins()
        return self._known

    @property
    def limits(self) -> LimitsConfig:
        """The limits in force: those of the configuration, or what a client has tightened them
        to.
        """
        return self.modules.tightened or self.base.limits

    @property
    def robot_facts(self) -> RobotFacts:
        """Which robot is or would be started, and whether it is a real one."""
        robot = self.config.robot
        registry = self._known or self.registry  # not looked for with each answer of a tool
        spec = registry.specs(RobotSpec).get(robot.name)
        driver = None if spec is None else spec.driver(robot.driver)
        kind: Literal["real", "simulated"] = (
            "simulated" if driver is not None and driver.simulated else "real"
        )
        return RobotFacts(name=robot.name, driver=robot.driver, kind=kind)

    def takes_policies(self) -> bool:
        """Whether any policy could move the present robot; true of a robot whose plugin is gone."""
        spec = self.registry.specs(RobotSpec).get(self.config.robot.name)
        return spec is None or bool(spec.action_widths)

    def camera_roles(self) -> dict[str, str]:
        """Camera name -> role of the present robot; empty when its plugin is gone."""
        spec = self.registry.specs(RobotSpec).get(self.config.robot.name)
        return {} if spec is None else {camera.name: camera.role for camera in spec.cameras}

    def select(self, kind: ModuleKind, request: Arguments | None, role: str = "") -> Plan:
        """What a client with `role` asks for, or else what is configured, checked against what is
        installed and runs.

        Nothing is changed.

        Raises:
            RoboNeuronError: as `choose` and `check`.
        """
        plan = self.choose(
            kind, self.base if kind == "robot" else self.config, self.registry, request, role
        )
        self.check(plan)
        return plan

    def check(self, plan: Plan) -> None:
        """Refuse what does not go together with the modules that run, or could not move now.

        Raises:
            StateError: another module works for another robot.
            RefusedError: a backend with an instruction proves itself by an action, and the
                emergency stop is latched.
            RoboNeuronError: as `Plan.check_beside` of a module that runs, or of this one.
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
    ) -> ModuleView:
        """Start a module for a client with `role`; as configured when there is no request.

        Raises:
            RoboNeuronError: as `select` and `Supervisor.start`.
        """
        return self.start_selected(self.select(kind, request, role), on_stage)

    def start_selected(self, plan: Plan, on_stage: Stage) -> ModuleView:
        """Start what `select` returned. An instruction in it is a start of motion. Raises as
        `Supervisor.start`.
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
        self.launch(plan, on_stage)
        if kind == "inference":
            self.starts.follow(self._supervisor.slot(kind), ticket)
        else:
            self.starts.arm_started()  # motion may have been asked for while it was being started
        return self.modules.view(kind)

    def launch(
        self,
        plan: Plan,
        on_stage: Stage = lambda stage: None,
        beside: Slot | None = None,
    ) -> None:
        """Start a process, as nobody's start of motion: once more what has ended, or in a slot
        beside the module that works. Raises as `Supervisor.start`.
        """
        self._supervisor.start(plan, on_stage, beside)

    def end(self, ended: Slot | ModuleKind) -> Stopped:
        """End the process in a slot, or the module of a kind and a start in progress, for another
        one that takes its place: nobody is told of a stop. Raises as `Supervisor.stop`.
        """
        if isinstance(ended, Slot):
            return self._supervisor.end(ended)
        return self._supervisor.stop(ended)

    def parameters(self, slot: Slot) -> NodeClient:
        """The parameters of the module in a slot. Raises StateError: its process has ended."""
        return self._supervisor.parameters(slot)

    def stream(self, namespace: str) -> deque[SentAction]:
        """What is sent on a robot's action topic since a backend was first started for it."""
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
        for kind in MODULE_KINDS:
            self.on_stop(kind)
        try:
            return self._supervisor.stop_all()
        finally:
            self.starts.stop("robot", "everything was stopped", is_asked=True)

    def cancel(self, kind: ModuleKind, reason: str = "the client cancelled the call.") -> None:
        """Whoever asked for a start does not want it any more."""
        self._supervisor.cancel(kind, reason)

    def set_parameters(
        self,
        kind: ModuleKind,
        values: Mapping[str, str | int],
        timeout_s: float,
        start_s: float = 0.0,
    ) -> str:
        """Ask the modules of a kind that run, one that is to replace another too, to take values.

        Args:
            kind: which modules.
            values: by the name of the parameter.
            timeout_s: bound on the answer of each.
            start_s: how long to wait for the end of a start in progress.

        Returns:
            Why the first one that refused did; empty when all took them.

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
