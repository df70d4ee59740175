"""The simulated FR3 is moved by a model behind `roboneuron serve-policy`, over TLS, and its motion
when that server freezes, dies and restarts.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import RunningServer, pair

from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_plan
from rn_testing.spinning import spinning_node
from rn_testing.waiting import wait_until
from roboneuron.config import parse_config
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.supervisor import Supervisor

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "shared"
instruction = "go on"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 90.0
[plugins.fr3-sim-camera]
width = 64
height = 64
rate_hz = 20.0
[plugins.shared]
address = "{address}"
timeout_s = 0.4
"""
HOLD_S = 2.0
"""timeout_s, max_tail_age_s and action_timeout_s are shorter; the rest is for a busy machine."""
LOOKED_AT_S = 3.0
STILL_RAD = 1e-3
MOST_STEP_RAD = 0.02
"""Between two measurements; the commanded motion is a hundredth of it, so more would be a jump."""


@dataclass
class Witness:
    """Messages published so far.

    Attributes:
        joints: measured positions, with monotonic times [s].
        actions: times of the rows [s].
    """

    joints: list[tuple[float, np.ndarray]] = field(default_factory=list)
    actions: list[float] = field(default_factory=list)

    def on_joints(self, message: Any) -> None:
        """Store measured joints."""
        named = dict(zip(message.name, message.position, strict=True))
        self.joints.append((time.monotonic(), np.array([named[joint] for joint in ARM])))

    def on_action(self, message: Any) -> None:
        """Store the time of a row."""
        self.actions.append(time.monotonic())

    def since(self, since_s: float) -> np.ndarray:
        """Joints measured since then (n, 7)."""
        return np.array([values for at_s, values in self.joints if at_s >= since_s])

    def moved_rad(self, since_s: float) -> float:
        """Largest travel of a joint since then."""
        seen = self.since(since_s)
        return float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0

    def rest_after_s(self, fault_s: float) -> float:
        """Time from a fault until the last motion of a joint, within the observed time [s]."""
        seen = [(at_s, values) for at_s, values in self.joints if at_s >= fault_s]
        last = seen[-1][1]
        away = [at_s for at_s, values in seen if np.abs(values - last).max() > STILL_RAD]
        return away[-1] - fault_s if away else 0.0


@contextmanager
def listening() -> Iterator[Witness]:
    """A node that receives joints and actions."""
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.qos import NEWEST

    seen = Witness()
    with spinning_node("fr3") as node:
        node.create_subscription(JointState, "joint_states", seen.on_joints, NEWEST)
        node.create_subscription(Float64MultiArray, "action", seen.on_action, 100)
        yield seen


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RunningServer]:
    """A server whose model moves slowly in one direction, six rows at a time."""
    pair(tmp_path / "robot", tmp_path / "gpu")
    model = {"only": {"options": {"rows": 6, "gain": 0.0002}}}
    made = RunningServer(tmp_path, model, {}, tmp_path / "gpu")
    try:
        yield made.start()
    finally:
        made.end()


@pytest.fixture
def seen(
    tmp_path: Path, server: RunningServer, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Witness]:
    """All modules, once the arm moves."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros"))
    # only the model uses the keys in this test, ROS does not
    monkeypatch.setenv("ROBONEURON_LINK", "off")
    prepare_environment(tmp_path / "log")
    config = parse_config(CONFIG.format(address=server.address))
    supervisor = Supervisor(tmp_path / "state")
    try:
        with listening() as witness:
            for kind in ("robot", "perception", "control", "inference"):
                supervisor.start(fake_plan(kind, config))
            check_it_moves(witness, time.monotonic())
            report = supervisor.view("inference").report
            assert report is not None
            yield witness
    finally:
        supervisor.close()


def check_it_moves(seen: Witness, since_s: float) -> None:
    wait_until(lambda: seen.moved_rad(since_s) > 5 * STILL_RAD, 60.0, "the arm moves")


def check_it_rests(seen: Witness, fault_s: float, what: str) -> None:
    wait_until(lambda: time.monotonic() > fault_s + LOOKED_AT_S, 2 * LOOKED_AT_S)
    after_s = seen.rest_after_s(fault_s)
    print(f"at rest {after_s:.2f} s after the server {what}")
    assert after_s < HOLD_S
    assert [at_s for at_s in seen.actions if fault_s + HOLD_S < at_s < fault_s + LOOKED_AT_S] == []


@pytest.mark.exhaustive
def test_the_arm_holds_while_the_server_is_away_and_goes_on_when_it_is_back(
    seen: Witness, server: RunningServer
) -> None:
    port, pid = server.port, server.pid
    fault_s = time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    try:
        check_it_rests(seen, fault_s, "froze")
    finally:
        os.kill(pid, signal.SIGCONT)
    check_it_moves(seen, time.monotonic())

    model = server.status()["models"]["only"]["pid"]
    fault_s = time.monotonic()
    os.kill(model, signal.SIGSTOP)
    try:
        check_it_rests(seen, fault_s, "had a model that froze")
    finally:
        os.kill(model, signal.SIGCONT)
    check_it_moves(seen, time.monotonic())

    fault_s = time.monotonic()
    server.kill()
    check_it_rests(seen, fault_s, "died")
    server.start("--port", str(port))
    check_it_moves(seen, time.monotonic())

    steps = np.abs(np.diff(seen.since(0.0), axis=0))
    assert steps.max() < MOST_STEP_RAD, "the arm never jumped"
