"""Fixtures of the gate tests: clocks that tests turn, an allow list of typical endpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from rn_standard.direct_path.fields import filled, load_type
from rn_standard.direct_path.gate import Gate
from rn_standard.direct_path.request import AllowedEndpoint
from roboneuron.contract import Endpoint, GripperProfile, JointLimits, JointSample, RobotProfile
from roboneuron.feature import GateRequest
from roboneuron.gate import AuditLog, EmergencyStopLatch

ONE = np.ones(2)
PROFILE = RobotProfile(
    name="arm",
    arm_joints=("j1", "j2"),
    limits=JointLimits(
        lower=-ONE, upper=ONE, velocity=2 * ONE, acceleration=10 * ONE, effort=50 * ONE
    ),
    gripper=GripperProfile(joint="finger", closed_position=0.0, open_position=0.04),
)
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
        dry_run: bool = False,
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
        return Gate(allowed, latch=latch, audit=audit, clock=clock.monotonic, dry_run=dry_run)

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
