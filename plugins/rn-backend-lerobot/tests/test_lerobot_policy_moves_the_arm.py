"""A LeRobot policy under its own interpreter moves the simulated FR3 from published images; and
faults of the policy.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.profile import profile
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_plan
from rn_testing.spinning import spinning_node
from rn_testing.waiting import holds_within, wait_until
from roboneuron import RoboNeuronError
from roboneuron.config import Config, parse_config
from roboneuron.ros.environment import prepare_environment
from roboneuron.supervisor.supervisor import Supervisor

ROOT = Path(__file__).parents[3]
PYTHON = ROOT / ".venv-lerobot-policies" / "bin" / "python"
LOOPS = Path(__file__).parent / "policies"
pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(180),
    pytest.mark.skipif(
        not PYTHON.exists(), reason="LeRobot is not installed: make .venv-lerobot-policies"
    ),
]
ARM = tuple(f"fr3_joint{i}" for i in range(1, 8))
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "lerobot"
checkpoint = "{checkpoint}"
python = "{python}"
execution = "sequential"
instruction = "pick up the red cube"
[control]
controller = "urdf"
[supervisor]
start_timeout_s = 90.0
[plugins.fr3-sim-camera]
width = 96
height = 96
rate_hz = 20.0
[plugins.lerobot]
rate_hz = 10.0
joints = ["fr3_joint1", "fr3_joint2", "fr3_joint3", "fr3_joint4", "fr3_joint5", "fr3_joint6",
  "fr3_joint7", "gripper_open"]
joint_unit = "radians"
gripper_unit = "open_fraction"
device = "cpu"
threads = 1
"""
SAME_RAD = 2e-4
"""Tolerance, because the joints measured with the image are not those of the newest message: a
resting simulation moves by less, and so does the policy's answer.
"""
HOLD_S = 1.5
"""max_tail_age_s and action_timeout_s are shorter; the rest is for a busy machine."""
LOOKED_AT_S = 3.0
"""Time for which the arm is observed after a fault."""
STILL_RAD = 1e-3


@dataclass
class Witness:
    """Messages published so far.

    Attributes:
        images: newest image by camera, and whether it ever changed before the first action.
        joints: measured positions by name, with monotonic times [s].
        actions: rows, with their label.
    """

    images: dict[str, np.ndarray] = field(default_factory=dict)
    joints: list[tuple[float, dict[str, float]]] = field(default_factory=list)
    actions: list[tuple[str, np.ndarray]] = field(default_factory=list)
    first: dict[str, Any] = field(default_factory=dict)

    def on_image(self, camera: str, message: Any) -> None:
        """Store an image."""
        image = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
        self.images[camera] = image.copy()

    def on_joints(self, message: Any) -> None:
        """Store measured joints."""
        named = dict(zip(message.name, message.position, strict=True))
        self.joints.append((time.monotonic(), named))

    def on_action(self, message: Any) -> None:
        """Store a row; with the first one, also the images and joints before it."""
        if not self.actions:
            self.first = {"images": dict(self.images), "joints": self.joints[-1][1]}
        self.actions.append((message.layout.dim[0].label, np.array(message.data)))

    def rest_after_s(self, fault_s: float) -> float:
        """Time from a fault until the last motion of a joint, within the observed time [s]."""
        seen = [(at_s, named) for at_s, named in self.joints if at_s >= fault_s]
        last = seen[-1][1]
        away = [at_s for at_s, named in seen if _apart_rad(named, last) > STILL_RAD]
        return away[-1] - fault_s if away else 0.0

    def moved_rad(self, since_s: float) -> float:
        """Largest travel of a joint since then."""
        seen = [[named[joint] for joint in ARM] for at_s, named in self.joints if at_s >= since_s]
        return float(np.ptp(np.array(seen), axis=0).max()) if seen else 0.0


def _apart_rad(one: dict[str, float], other: dict[str, float]) -> float:
    return max(abs(one[joint] - other[joint]) for joint in ARM)


@contextmanager
def listening() -> Iterator[Witness]:
    """A node that receives images, joints and actions."""
    from sensor_msgs.msg import Image, JointState
    from std_msgs.msg import Float64MultiArray

    from roboneuron.ros.qos import NEWEST

    seen = Witness()
    with spinning_node("fr3") as node:
        for camera in ("front", "wrist"):
            node.create_subscription(
                Image,
                f"camera/{camera}/image",
                lambda message, camera=camera: seen.on_image(camera, message),
                NEWEST,
            )
        node.create_subscription(JointState, "joint_states", seen.on_joints, NEWEST)
        node.create_subscription(Float64MultiArray, "action", seen.on_action, 100)
        yield seen


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function that lets LeRobot write a tiny policy, once."""
    root = tmp_path_factory.mktemp("policies")

    @functools.cache
    def make(policy: str) -> Path:
        run = [
            PYTHON,
            "-m",
            "rn_backend_lerobot.cli",
            "make-tiny",
            root / policy,
            "--policy",
            policy,
        ]
        subprocess.run([*map(str, run)], check=True, capture_output=True, timeout=150)
        return root / policy

    return make


@dataclass
class Cell:
    """The processes, and their messages."""

    supervisor: Supervisor
    seen: Witness
    config: Config

    def start(self, kind: Any) -> None:
        """Start one module, inference under its own interpreter."""
        self.supervisor.start(fake_plan(kind, self.config))

    def rests(self, for_s: float) -> bool:
        """True if the arm does not move for this time from now on."""
        begin_s = time.monotonic()
        return not holds_within(lambda: self.seen.moved_rad(begin_s) > STILL_RAD, for_s)


@pytest.fixture
def cell(
    tmp_path: Path, made: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Cell]:
    """Robot, cameras and control, without inference; an ACT is configured."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "ros"))
    prepare_environment(tmp_path / "log")
    config = parse_config(CONFIG.format(checkpoint=made("act"), python=PYTHON))
    supervisor = Supervisor(tmp_path / "state")
    try:
        with listening() as seen:
            cell = Cell(supervisor, seen, config)
            for kind in ("robot", "perception", "control"):
                cell.start(kind)
            wait_until(lambda: seen.joints and len(seen.images) == 2, 20.0, "the cell is seen")
            yield cell
    finally:
        supervisor.close()


def test_it_moves_the_arm_as_lerobot_would_and_stands_when_its_process_is_killed(
    cell: Cell, made: Callable[[str], Path], tmp_path: Path
) -> None:
    began_s = time.monotonic()
    cell.start("inference")
    wait_until(lambda: len(cell.seen.actions) >= 30, 30.0, "the policy acts")
    labels = {label for label, _ in cell.seen.actions}
    assert labels == {f"joint_position@10:{','.join(ARM)},gripper_open"}
    assert cell.seen.moved_rad(began_s) > 0.02
    report = cell.supervisor.view("control").report
    assert report is not None
    assert report.dropped_by == {}
    check_actions(cell, made("act"), tmp_path, 8)

    process = cell.supervisor.view("inference").process
    assert process is not None
    killed_s = time.monotonic()
    os.kill(process.pid, signal.SIGKILL)
    wait_until(lambda: time.monotonic() > killed_s + LOOKED_AT_S, 2 * LOOKED_AT_S)
    after_s = cell.seen.rest_after_s(killed_s)
    print(f"at rest {after_s:.2f} s after the policy's interpreter was killed")
    assert after_s < HOLD_S
    assert cell.supervisor.view("inference").phase == "exited"


@pytest.mark.parametrize(("policy", "rows"), [("smolvla", 8), ("diffusion", 1)])
def test_other_policies_move_the_arm_as_lerobot_would(
    cell: Cell, made: Callable[[str], Path], tmp_path: Path, policy: str, rows: int
) -> None:
    """Diffusion is queried row by row: its second row answers a second image."""
    config = parse_config(CONFIG.format(checkpoint=made(policy), python=PYTHON))
    cell.supervisor.start(fake_plan("inference", config))
    wait_until(lambda: len(cell.seen.actions) >= 20, 30.0, "the policy acts")
    check_actions(cell, made(policy), tmp_path, rows)


def check_actions(cell: Cell, checkpoint: Path, folder: Path, rows: int) -> None:
    """The first actions are those of LeRobot's own engine."""
    ours = np.array([row for _, row in cell.seen.actions[:rows]])
    theirs = lerobots_actions(cell.seen.first, checkpoint, folder, rows)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=SAME_RAD)


def lerobots_actions(
    first: dict[str, Any], checkpoint: Path, folder: Path, rows: int
) -> np.ndarray:
    """The answer of LeRobot's own engine to the messages published before the first action."""
    gripper = profile().gripper
    assert gripper is not None
    joints = first["joints"]
    state = [*(joints[name] for name in ARM), gripper.to_opening(joints[gripper.joint])]
    source, target = folder / "seen.npz", folder / "actions.npy"
    np.savez(
        source,
        front=first["images"]["front"],
        wrist=first["images"]["wrist"],
        names=np.array([*ARM, "gripper_open"]),
        state=np.array(state),
        instruction=np.array("pick up the red cube"),
    )
    run = [PYTHON, LOOPS / "lerobot_actions.py", checkpoint, source, target, rows]
    subprocess.run([*map(str, run)], check=True, capture_output=True, timeout=120)
    actions: np.ndarray = np.load(target)
    return actions


def edited(checkpoint: Path, folder: Path, feature: str) -> Path:
    """The checkpoint with its front camera renamed, or of another type."""
    shutil.copytree(checkpoint, folder)
    for path in folder.glob("*.json"):
        text = path.read_text().replace("observation.images.front", feature)
        document = json.loads(text)
        if feature in document.get("input_features", {}) and "image" not in feature:
            document["input_features"][feature] = {"type": "ENV", "shape": [3]}
        path.write_text(json.dumps(document))
    return folder


def test_what_does_not_fit_is_one_sentence_and_the_arm_rests(
    cell: Cell, made: Callable[[str], Path], tmp_path: Path
) -> None:
    began_s, checkpoint = time.monotonic(), made("act")
    other = tmp_path / "site" / "lerobot-0.5.1.dist-info"
    other.mkdir(parents=True)
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot\nVersion: 0.5.1\n")
    cases = {
        "observation.environment_state": r"takes 'observation.environment_state' (ENV",
        "observation.images.overhead": "has no statistic 'mean' of 'observation.images.overhead'",
    }
    for number, (feature, words) in enumerate(cases.items()):
        folder = edited(checkpoint, tmp_path / f"policy{number}", feature)
        said = refusal(cell, parse_config(CONFIG.format(checkpoint=folder, python=PYTHON)))
        assert words in said
    unmapped = CONFIG.format(checkpoint=checkpoint, python=PYTHON)
    unmapped += '\n[plugins.lerobot.cameras]\nfront = "side"\n'
    said = refusal(cell, parse_config(unmapped))
    assert "robot 'fr3' has no camera for it; it has: front (role primary)" in said
    older = tmp_path / "python"
    older.write_text(f'#!/bin/sh\nPYTHONPATH={other.parent} exec {PYTHON} "$@"\n')
    older.chmod(0o755)
    text = CONFIG.format(checkpoint=checkpoint, python=older)
    said = refusal(cell, parse_config(text))
    assert "LeRobot 0.5.1 is installed in" in said
    assert cell.seen.actions == []
    assert cell.seen.moved_rad(began_s) < STILL_RAD


def refusal(cell: Cell, config: Config) -> str:
    """Error message of an inference that cannot start."""
    with pytest.raises(RoboNeuronError) as refused:
        cell.supervisor.start(fake_plan("inference", config))
    assert "\n" not in refused.value.message
    return refused.value.message
