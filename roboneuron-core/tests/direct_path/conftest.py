"""Fixtures of the gate tests: an allow list of typical endpoints, and the gate as features use it.

The gate and the arbiter are real; what would be on ROS is played by the test.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from rn_testing.gate_fixtures import Clock
from roboneuron.contract import Endpoint, GripperProfile, JointLimits, JointSample, RobotProfile
from roboneuron.direct_path import motion_gate as motion_gate_module
from roboneuron.direct_path.arbiter import MotionArbiter
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.motion_gate import DirectGate
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.direct_path.writer import TopicWriter
from roboneuron.errors import StateError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.estop.motion_claims import MotionClaims
from roboneuron.feature import ExposedEndpoint, GateRequest, TimedCommand
from roboneuron.gate import AuditLog

sys.path.append(str(Path(__file__).parent))  # for arbiter_cell
ONE = np.ones(2)
PROFILE = RobotProfile(
    name="arm",
    arm_joints=("j1", "j2"),
    limits=JointLimits(
        lower=-ONE, upper=ONE, velocity=2 * ONE, acceleration=10 * ONE, effort=50 * ONE
    ),
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
)
HERE = JointSample(names=("j1", "j2", "finger"), position=np.array([0.1, 0.2, 0.0]))
AT_ZERO = JointSample(names=("j1", "j2", "finger"), position=np.zeros(3))
VELOCITY = Endpoint(
    name="velocity",
    kind="publish",
    topic="cmd_vel",
    type="geometry_msgs/msg/Twist",
    summary="drive",
    bounds={"linear.x": (-0.5, 0.5), "linear.y": (0.0, 0.0), "angular.z": (-1.0, 1.0)},
    rate_hz=5.0,
)
TRAJECTORY = Endpoint(
    name="trajectory",
    kind="publish",
    topic="joint_trajectory",
    type="trajectory_msgs/msg/JointTrajectory",
    summary="move",
    joint_limited=True,
)
JOINTS = Endpoint(
    name="joints",
    kind="publish",
    topic="joint_command",
    type="sensor_msgs/msg/JointState",
    summary="move",
    joint_limited=True,
)
ENABLE = Endpoint(
    name="enable", kind="service", topic="enable", type="std_srvs/srv/SetBool", summary="switch on"
)
SCAN = Endpoint(
    name="scan", kind="read", topic="scan", type="sensor_msgs/msg/LaserScan", summary="look"
)
GOAL = Endpoint(
    name="pose",
    kind="publish",
    topic="goal",
    type="geometry_msgs/msg/PoseArray",
    summary="go",
    bounds={"poses.position.x": (0.0, 1.0)},
)


@pytest.fixture
def make_gate(latch: EmergencyStopLatch, audit: AuditLog, clock: Any) -> Callable[..., Gate]:
    """A gate over all endpoints above; keyword arguments change one of them or the gate."""

    def make(
        changed: Endpoint | None = None,
        simulated: bool = False,
        audit: AuditLog = audit,
        **entry: Any,
    ) -> Gate:
        endpoints = {e.name: e for e in (VELOCITY, TRAJECTORY, JOINTS, ENABLE, SCAN, GOAL)}
        if changed is not None:
            endpoints[changed.name] = changed
        allowed = [
            AllowedEndpoint(robot="arm", endpoint=e, profile=PROFILE, **entry)
            for e in endpoints.values()
        ]
        return Gate(allowed, latch=latch, audit=audit, clock=clock.monotonic, simulated=simulated)

    return make


def encode(type_name: str, value: dict[str, Any]) -> Any:
    """A rosidl message; for services the request. `time_from_start` may be given in seconds."""
    ros_type = load_type(type_name)
    return filled(getattr(ros_type, "Request", ros_type), _written_out(value))


def _written_out(value: Any) -> Any:
    if isinstance(value, list):
        return [_written_out(item) for item in value]
    if not isinstance(value, dict):
        return value
    made = {name: _written_out(item) for name, item in value.items()}
    if isinstance(made.get("time_from_start"), int | float):
        seconds, nanoseconds = divmod(round(made["time_from_start"] * 1e9), 1_000_000_000)
        made["time_from_start"] = {"sec": seconds, "nanosec": nanoseconds}
    return made


@pytest.fixture
def ask() -> Callable[..., GateRequest]:
    """A request of an operator; `value` is encoded for the endpoint."""

    def make(
        endpoint: Endpoint, value: dict[str, Any] | None = None, /, **changes: Any
    ) -> GateRequest:
        messages = () if value is None else (encode(endpoint.type, value),)
        request = GateRequest(
            who="agent-1",
            role="operator",
            tool=f"publish_{endpoint.name}",
            robot="arm",
            endpoint=endpoint.name,
            messages=messages,
            arguments=value or {},
            joints=AT_ZERO,
        )
        return replace(request, **changes)

    return make


@pytest.fixture
def endpoints() -> dict[str, Endpoint]:
    """The endpoints by name."""
    return {e.name: e for e in (VELOCITY, TRAJECTORY, JOINTS, ENABLE, SCAN, GOAL)}


class Writer:
    """A topic with subscribers that come when the test says so."""

    topic = "/arm/cmd_vel"

    def __init__(self, clock: Clock) -> None:
        self.published: list[Any] = []
        self.waits_s: list[float] = []
        self.subscribers = 2
        self.listeners = 2
        self.misfit = ""
        self.has_new_misfit = False
        self.takes_s = 0.0
        self.on_connect: Callable[[], object] = lambda: None
        self._clock = clock
        self._publisher = self
        self._signature = ""

    def listening(self) -> int:
        return self.listeners

    def matched(self) -> int:
        return self.subscribers

    def connect(self, timeout_s: float) -> int:
        self.waits_s.append(timeout_s)
        self._clock.now_s += self.takes_s
        self.on_connect()
        return self.subscribers

    def publish(self, message: Any) -> None:
        self.published.append(message)

    publish_if_possible = publish

    def send(self, message: Any, stamped: bool) -> None:
        TopicWriter.send(self, message, stamped)  # type: ignore[arg-type]


class Traffic:
    """Stands for ROS."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.made = Writer(clock)
        self.is_known = True
        self.waits_s: list[float] = []
        self.now_joints: JointSample | None = HERE
        self.calls: list[tuple[Any, ...]] = []
        self.goals: list[tuple[Any, dict[str, Any]]] = []
        self.served = [True]
        self.is_on_executor = False
        self.sent_on_executor: list[bool] = []

    def known_writer(self, exposed: ExposedEndpoint) -> Writer | None:
        assert isinstance(exposed, ExposedEndpoint)
        return self.made if self.is_known else None

    def writer(self, exposed: ExposedEndpoint) -> Writer:
        assert isinstance(exposed, ExposedEndpoint)
        return self.made

    def newest_joints(self, exposed: ExposedEndpoint) -> JointSample | None:
        assert isinstance(exposed, ExposedEndpoint)
        return self.now_joints

    def joints(self, exposed: ExposedEndpoint, timeout_s: float) -> JointSample | None:
        self.waits_s.append(timeout_s)
        return self.newest_joints(exposed)

    def is_served(self, exposed: ExposedEndpoint) -> bool:
        assert isinstance(exposed, ExposedEndpoint)
        return self.served.pop(0) if len(self.served) > 1 else self.served[0]

    def check_server(self, exposed: ExposedEndpoint) -> None: ...

    def cancel_goal(self, exposed: ExposedEndpoint, goal_id: object) -> None: ...

    def link(self) -> Any:
        return SimpleNamespace(
            call=lambda *told: self.calls.append(told) or "the call", on_executor=self.on_executor
        )

    def on_executor(self, task: Callable[[], Any]) -> Any:
        self.is_on_executor = True
        try:
            return task()
        finally:
            self.is_on_executor = False

    def action_client(self, exposed: ExposedEndpoint) -> Any:
        assert isinstance(exposed, ExposedEndpoint)

        def send(goal: Any, **options: Any) -> str:
            self.goals.append((goal, options))
            self.sent_on_executor.append(self.is_on_executor)
            return "the future"

        return SimpleNamespace(send_goal_async=send)


class Bench:
    """The gate as features use it."""

    def __init__(self, gate: Gate, clock: Clock) -> None:
        self.clock = clock
        self.gate = gate
        self.checked: list[GateRequest] = []
        self.next: list[GateRequest] = []
        self._check, self._check_next = gate.check, gate.check_next
        gate.check = self.check  # type: ignore[method-assign]
        gate.check_next = self.check_next  # type: ignore[method-assign]
        self.policy, nothing = "", cast("Any", None)
        claims = MotionClaims(nothing)
        claims.policy = lambda robot, namespace: self.policy  # type: ignore[method-assign]
        self.starts: Any = SimpleNamespace(look=lambda: None, arm_stops=0, reason="", claims=claims)
        gate.latch.on_press.append(claims.stop_now)
        gate.latch.on_pressed.append(claims.wake)
        self.arbiter = MotionArbiter(gate, self.starts)
        self.traffic = Traffic(clock)
        self.permitted: list[str] = []
        self.on_permit: Callable[[], object] = lambda: None
        self.is_still = False
        self.listed = SimpleNamespace(exposed=("one",), expose=None, relimit=None)
        self.motion_gate = DirectGate(
            gate,
            self.arbiter,
            self.traffic,  # type: ignore[arg-type]
            self.listed,  # type: ignore[arg-type]
            60.0,
            self.permit,
            lambda: self.is_still,
        )

    def check(self, request: GateRequest) -> Any:
        self.checked.append(request)
        return self._check(request)

    def check_next(self, request: GateRequest) -> None:
        self.next.append(request)
        self._check_next(request)

    def permit(self, exposed: ExposedEndpoint, stops: int) -> None:
        if stops != self.starts.arm_stops:
            raise StateError(f"Motion was forbidden meanwhile: {self.starts.reason}.")
        self.permitted.append(exposed.label)
        self.on_permit()

    @property
    def writer(self) -> Writer:
        return self.traffic.made

    @property
    def sent(self) -> list[Any]:
        return self.writer.published

    def play(
        self,
        place: ExposedEndpoint,
        request: GateRequest,
        *,
        commands: Any = None,
        total_s: float = 2.0,
        timeout_s: float = 1.0,
        halt: threading.Event | None = None,
        **options: Any,
    ) -> Any:
        """Send the request's messages as a motion, each due at once."""
        due = [TimedCommand(message=message, due_s=0.0) for message in request.messages]
        return self.motion_gate.play(
            place,
            request,
            due if commands is None else commands,
            total_s=total_s,
            timeout_s=timeout_s,
            halt=halt or threading.Event(),
            **options,
        )

    def send_one(self, place: ExposedEndpoint, request: GateRequest, how: str) -> Any:
        """Send one message: without blocking, with, or as a motion."""
        if how == "now":
            return self.motion_gate.publish_now(place, request)
        if how == "motion":
            return self.play(place, request, timeout_s=0.5)
        return self.motion_gate.publish(place, request, timeout_s=0.5)


@pytest.fixture
def make_bench(monkeypatch: pytest.MonkeyPatch) -> Callable[[Gate], Bench]:
    """A gate as features use it, on a clock of its own."""

    def make(gate: Gate) -> Bench:
        clock = Clock()
        monkeypatch.setattr(motion_gate_module, "time", clock)
        return Bench(gate, clock)

    return make


@pytest.fixture
def bench(make_gate: Callable[..., Gate], make_bench: Callable[[Gate], Bench]) -> Bench:
    """The gate over all endpoints, as features use it."""
    return make_bench(make_gate())


@pytest.fixture
def expose() -> Callable[..., ExposedEndpoint]:
    """An endpoint as agents may use it."""

    def make(endpoint: Endpoint, **changes: Any) -> ExposedEndpoint:
        return ExposedEndpoint(
            robot="arm", namespace="arm", label=endpoint.name, endpoint=endpoint, **changes
        )

    return make


@pytest.fixture
def drive(expose: Callable[..., ExposedEndpoint]) -> ExposedEndpoint:
    """What a base is driven by."""
    return expose(VELOCITY)


@pytest.fixture
def move(expose: Callable[..., ExposedEndpoint]) -> ExposedEndpoint:
    """What joints are moved by."""
    return expose(JOINTS)


@pytest.fixture
def here() -> JointSample:
    """Where the joints of a bench are measured."""
    return HERE


@pytest.fixture
def joint_request(ask: Callable[..., GateRequest]) -> Callable[..., GateRequest]:
    """A small motion of the joints from there."""

    def make(**changes: Any) -> GateRequest:
        value = {"name": ["j1", "j2"], "position": [0.11, 0.2]}
        return ask(JOINTS, value, **({"joints": HERE} | changes))

    return make
