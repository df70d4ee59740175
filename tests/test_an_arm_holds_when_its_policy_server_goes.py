"""The real processes with a policy of joint velocities behind openpi's websocket: the arm moves,
comes to rest when the server ends, and moves on when it is back.
"""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_backend_openpi.case import Reflex, serving
from rn_testing.fakes import fake_plan
from rn_testing.spinning import spinning_node
from rn_testing.waiting import holds_within, wait_until
from roboneuron.config import parse_config
from roboneuron.contract import ActionChunk, Channel, ControlSpace, Observation
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.supervisor import Supervisor

JOINTS = tuple(f"fr3_joint{i}" for i in range(1, 8))
SPEED_RAD_S = 0.1
SPACE = ControlSpace(
    kind="joint_velocity",
    channels=(
        *(Channel(name=name, unit="rad/s") for name in JOINTS),
        Channel(name="gripper_open", unit="opening"),
    ),
    rate_hz=15.0,
)
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "openpi"
instruction = "turn the hand"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 90.0
[plugins.openpi]
profile = "droid"
url = "ws://127.0.0.1:{port}"
joints = {joints}
image_keys = {{ primary = "observation/exterior_image_1_left" }}
"""


class Turning(Reflex):
    """Turns the last joint slowly to and fro."""

    def __init__(self) -> None:
        super().__init__(space=SPACE)

    def predict(self, observation: Observation) -> ActionChunk:
        rows = np.zeros((8, 8))
        rows[:, 6] = SPEED_RAD_S if time.monotonic() % 8.0 < 4.0 else -SPEED_RAD_S
        rows[:, 7] = observation.gripper_open
        return ActionChunk(actions=rows, step_s=1 / 15, space=SPACE)


@dataclass
class Witness:
    """Observations.

    Attributes:
        labels: labels of actions.
        angles: angles of the last joint [rad], with monotonic times.
    """

    labels: list[str] = field(default_factory=list)
    angles: list[tuple[float, float]] = field(default_factory=list)

    def is_moving(self) -> bool:
        """True if the joint turned within the last half second."""
        now_s = time.monotonic()
        recent = [angle for at_s, angle in self.angles[-200:] if now_s - at_s < 0.5]
        return len(recent) > 10 and max(recent) - min(recent) > 0.2 * SPEED_RAD_S * 0.5

    def is_at_rest(self) -> bool:
        """True if the joint was measured and did not turn within the last half second."""
        now_s = time.monotonic()
        recent = [angle for at_s, angle in self.angles[-200:] if now_s - at_s < 0.5]
        return len(recent) > 10 and max(recent) - min(recent) < 1e-3


@contextmanager
def listening() -> Iterator[Witness]:
    """A separate node that observes actions and joint states."""
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    seen = Witness()

    def note_state(message: Any) -> None:
        seen.angles.append((time.monotonic(), message.position[6]))

    def note_action(message: Any) -> None:
        seen.labels.append(message.layout.dim[0].label)

    with spinning_node("fr3") as node:
        node.create_subscription(JointState, "joint_states", note_state, QoSProfile(depth=200))
        node.create_subscription(Float64MultiArray, "action", note_action, QoSProfile(depth=200))
        yield seen


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.ros
@pytest.mark.exhaustive  # the same as rn-backend-openpi shows of its servers
def test_the_arm_rests_while_there_is_no_server_and_moves_on_with_the_next(tmp_path: Path) -> None:
    port = free_port()
    config = parse_config(CONFIG.format(port=port, joints=json.dumps(JOINTS)))
    keys = {"primary": "observation/exterior_image_1_left"}
    interface = {"profile": "droid", "joints": JOINTS, "image_keys": keys}

    def serve() -> Any:
        return serving(Turning(), interface=interface, space=SPACE, port=port)

    prepare_environment(tmp_path / "log")
    supervisor = Supervisor(tmp_path / "state")
    try:
        with listening() as seen:
            with serve():
                for kind in ("robot", "perception", "control", "inference"):
                    supervisor.start(fake_plan(kind, config))
                wait_until(seen.is_moving, 30.0, "the arm moves")
            wait_until(seen.is_at_rest, 10.0, "the arm rests without its server")
            count = len(seen.labels)
            assert not holds_within(seen.is_moving, 2.0)
            # a row in transit when the server ended may still have been sent
            assert len(seen.labels) <= count + 1
            inference = supervisor.view("inference").report
            assert inference is not None
            assert "connection" in inference.error
            with serve():
                wait_until(seen.is_moving, 30.0, "the arm moves on")
            control = supervisor.view("control").report
    finally:
        supervisor.close()
    assert control is not None
    assert set(control.dropped_by) <= {"holds"}  # no row came late, and none was refused
    assert {label.partition(":")[0] for label in seen.labels} == {"joint_velocity@15"}
