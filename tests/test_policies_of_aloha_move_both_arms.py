"""ALOHA policies, pi0 and OpenVLA-OFT, move both arms of a robot through the real processes: the
rows on the topic equal the result of the conversions, and both arms stay within their limits.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import two_arms_plugin as robot
from plugin_site import installed

from rn_backend_oft.backend import OftPairBackend
from rn_backend_oft.config import OftConfig
from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.tiny import make_tiny_oft
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.profiles import JOINT_PROFILES
from rn_backend_pi0.tiny import make_tiny
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_testing.fakes import fake_plan
from rn_testing.spinning import spinning_node
from rn_testing.waiting import wait_until
from roboneuron.config import parse_config
from roboneuron.contract import (
    ActionChunk,
    ArmState,
    Backend,
    Frame,
    JointSample,
    Observation,
    Pose,
)
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.supervisor import Supervisor

CONFIG = """
[robot]
name = "two-arms"
[perception]
source = "grey"
cameras = ["high", "left_wrist", "right_wrist"]
[inference]
backend = "{backend}"
checkpoint = "{checkpoint}"
execution = "sequential"
instruction = "fold the shirt"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 90.0
"""
PI0 = """
[plugins.pi0]
joints = {joints}
device = "cpu"
cpu_threads = 1
noise = "fixed"
"""
OFT = """
[plugins.oft-pair]
profile = "joints"
constants = "aloha"
joints = {joints}
proprio = true
[plugins.torch]
device = "cpu"
dtype = "float32"
threads = 1
"""
NAMES = json.dumps(robot.JOINTS)
GRIPPERS = [6, 13]
NEAR_RAD = 0.03
"""Half the joint range of OFT, whose random rows would otherwise be refused as jumps."""


@dataclass
class Witness:
    """Observations of the topics.

    Attributes:
        rows: rows of actions, with their labels.
        states: joints (14) by their stamps [s].
    """

    rows: list[tuple[str, list[float]]] = field(default_factory=list)
    states: list[tuple[float, list[float]]] = field(default_factory=list)

    def note_action(self, message: Any) -> None:
        """Record a sent action."""
        self.rows.append((message.layout.dim[0].label, list(message.data)))

    def note_state(self, message: Any) -> None:
        """Record a measurement of the arms."""
        stamp = message.header.stamp
        self.states.append((stamp.sec + stamp.nanosec * 1e-9, list(message.position)))


@contextmanager
def listening() -> Iterator[Witness]:
    """A separate node that observes actions and joint states."""
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    seen = Witness()
    with spinning_node("two_arms") as node:
        node.create_subscription(JointState, "joint_states", seen.note_state, QoSProfile(depth=200))
        node.create_subscription(
            Float64MultiArray, "action", seen.note_action, QoSProfile(depth=200)
        )
        yield seen


def at_home() -> Observation:
    """Inference's observation before any motion."""
    names = (*robot.JOINTS, *robot.FINGERS)
    position = np.array([*robot.HOME_RAD * 2, *(robot.OPEN_M / 2.0,) * 2])
    # joint policies do not use the pose
    pose = Pose(position_m=np.zeros(3), quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0]))
    return Observation(
        frames={
            role: Frame(camera=name, image=robot.grey(48, 64), stamp_ns=1, frame_id=name)
            for name, role in robot.CAMERAS.items()
        },
        instruction="fold the shirt",
        joints=JointSample(names=names, position=position),
        gripper_open=0.5,
        arms={side: ArmState(ee_pose=pose, gripper_open=0.5) for side in robot.SIDES},
    )


def first_chunk(backend: Backend) -> ActionChunk:
    """The backend's answer in this process."""
    backend.load()
    try:
        return backend.predict(at_home())
    finally:
        backend.close()


def pi0(folder: Path) -> tuple[str, ActionChunk]:
    """Configuration of a tiny ALOHA pi0, and its first chunk by the formulas that
    test_pi0_joint_spaces_are_those_of_openpi compares with openpi's numbers.
    """
    make_tiny(folder / "pi0", layout="openpi", profile="aloha")
    options = Pi0Options(
        checkpoint=folder / "pi0", joints=robot.JOINTS, device="cpu", cpu_threads=1, noise="fixed"
    )
    chunk = first_chunk(Pi0Backend(options))
    layout = JOINT_PROFILES["aloha"]
    stats = json.loads((folder / "pi0/assets/tiny/norm_stats.json").read_text())["norm_stats"]
    normalized = chunk.context.normalized[:, :14].astype(np.float64)
    raw = normalized * (np.array(stats["actions"]["std"]) + 1e-6) + stats["actions"]["mean"]
    home = np.array([*robot.HOME_RAD, 0.5] * 2)
    told = layout.to_robot(raw, layout.to_network(home))
    told[:, GRIPPERS] = told[:, GRIPPERS].clip(0.0, 1.0)
    np.testing.assert_allclose(chunk.actions, told, atol=1e-9)
    text = CONFIG.format(backend="pi0", checkpoint=folder / "pi0") + PI0.format(joints=NAMES)
    return text, chunk


def oft(folder: Path) -> tuple[str, ActionChunk]:
    """Configuration of a tiny ALOHA OFT that stays near home, and its first chunk."""
    make_tiny_oft(folder / "oft", platform="aloha")
    home = np.array([*robot.HOME_RAD, 0.5] * 2)
    spread = np.array([*(NEAR_RAD,) * 6, 0.5] * 2)
    block = {
        bound: (home + sign * spread).tolist()
        for bound, sign in {"min": -1, "max": 1, "q01": -1, "q99": 1}.items()
    }
    statistics = {"tiny": {"action": block, "proprio": block}}
    (folder / "oft" / "dataset_statistics.json").write_text(json.dumps(statistics))
    options = OftConfig(
        checkpoint=folder / "oft",
        profile="joints",
        constants="aloha",
        joints=robot.JOINTS,
        proprio=True,
    )
    runtime = TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32", threads=1))
    chunk = first_chunk(OftPairBackend(options, runtime=runtime))
    assert len(chunk.actions) == CONSTANTS["aloha"].chunk
    text = CONFIG.format(backend="oft-pair", checkpoint=folder / "oft")
    return text + OFT.format(joints=NAMES), chunk


@pytest.mark.ros
@pytest.mark.timeout(180)
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(pi0, id="pi0", marks=pytest.mark.exhaustive),
        pytest.param(oft, id="oft", marks=pytest.mark.slow),
    ],
)
def test_both_arms_follow_a_policy_of_aloha(tmp_path: Path, make: Any) -> None:
    text, chunk = make(tmp_path)
    with installed(tmp_path, "rn-two-arms", (robot.PLUGIN,), source=Path(__file__).parent):
        prepare_environment(tmp_path / "log")
        config = parse_config(text)
        supervisor = Supervisor(tmp_path / "state")
        try:
            with listening() as seen:
                for kind in ("robot", "perception", "control", "inference"):
                    supervisor.start(fake_plan(kind, config))
                wanted = 3 * len(chunk.actions)
                wait_until(lambda: len(seen.rows) > wanted, 30.0, "three chunks were played")
            control = supervisor.view("control").report
        finally:
            supervisor.close()
    assert {label for label, _ in seen.rows} == {chunk.space.label}
    rows = np.array([row for _, row in seen.rows[: len(chunk.actions)]])
    # this node may discover inference one row late
    first = int(np.abs(chunk.actions - rows[0]).max(axis=1).argmin())
    assert first < len(rows) // 2
    # the same numbers in another process: float32 networks on one thread, float64 conversions
    same = np.isclose(rows[: len(rows) - first], chunk.actions[first:], rtol=0, atol=1e-9)
    # on a busy machine the next chunk replaces the last rows
    assert same[: len(rows) // 2].all(), rows - chunk.actions
    assert control is not None
    # no row was refused; a machine that stands still for the action timeout lets control hold once
    assert control.dropped_by.keys() <= {"holds"}
    assert control.metrics.get("hold_code", "no_action") == "no_action"
    check_motion(seen)


def check_motion(seen: Witness) -> None:
    """Check that every joint of both arms moved within its limits."""
    times = np.array([at_s for at_s, _ in seen.states])
    joints = np.array([position for _, position in seen.states])[:, : len(robot.JOINTS)]
    moved = np.ptp(joints, axis=0)
    assert moved.min() > 1e-3
    assert np.abs(joints).max() <= robot.REACH_RAD
    # over 50 ms, because stamps of the driver's readings are not exact to the microsecond
    later = np.searchsorted(times, times + 0.05)
    pairs = [(i, j) for i, j in enumerate(later) if j < len(times)]
    speeds = [np.abs(joints[j] - joints[i]).max() / (times[j] - times[i]) for i, j in pairs]
    assert max(speeds) <= robot.VELOCITY_RAD_S * 1.02
