"""lerobot moves an FR3 behind ros2_control, and one over the FCI, simulated by franka-sim."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from lerobot_lane import PATIENT, ROOT, Lerobot, Watch, serve

from rn_robot_fr3.fci.simulator import FrankaSim
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT
from rn_robot_fr3.profile import HOME_RAD
from roboneuron.plugins.availability import is_importable

END_S = 300.0
FCI_PYTHON = Path(
    os.environ.get("ROBONEURON_FR3SIM_PYTHON", ROOT / ".venv-fr3sim" / "bin" / "python")
)
pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def teleoperate(lerobot: Lerobot, config: Path, namespace: str, seconds: int = 8) -> None:
    """`lerobot-teleoperate`, led by a program that sways once in four seconds."""
    lerobot.lead("fr3", "--namespace", namespace)
    process = lerobot.start(
        "lerobot-teleoperate",
        "--robot.type=roboneuron",
        "--robot.robot=fr3",
        f"--robot.namespace={namespace}",
        "--robot.perception=false",
        *PATIENT,
        "--robot.state_timeout_s=5",
        serve(config),
        "--teleop.type=roboneuron",
        "--teleop.robot=fr3",
        "--fps=20",
        f"--teleop_time_s={seconds}",
    )
    assert process.wait(END_S) == 0, lerobot.last_line(process)


def assert_swayed(rows: np.ndarray) -> None:
    """Check that it moved like the leader, 0.25 rad and 0.3 rad to each side."""
    travel = np.ptp(rows, axis=0)
    assert travel[0] == pytest.approx(0.5, abs=0.05)
    assert travel[4] == pytest.approx(0.6, abs=0.06)


@pytest.mark.skipif(not is_importable("control_msgs"), reason="control_msgs is not built here")
def test_an_arm_behind_ros2_control_is_teleoperated(
    lerobot: Lerobot, tmp_path: Path, stack: ExitStack
) -> None:
    config = tmp_path / "fr3.toml"
    config.write_text(
        '[robot]\nname = "fr3"\ndriver = "ros2-control"\nnamespace = "roboneuron_fr3"\n'
        '[control]\ncontroller = "urdf"\n'
        '[plugins.fr3]\ncontroller = "/fr3_arm_controller"\n'
        'gripper = "gripper-command"\n',
        encoding="utf-8",
    )
    command = [sys.executable, "-m", "rn_driver_ros2control.standin_node"]
    command += ["--controller", "/fr3_arm_controller", "--joints", *ARM_JOINTS]
    command += ["--start", *map(str, HOME_RAD), "--gripper-joint", FINGER_JOINT]
    log = stack.enter_context((tmp_path / "controller.log").open("wb"))
    controller = stack.enter_context(subprocess.Popen(command, stdout=log, stderr=log))
    stack.callback(controller.terminate)
    watch = Watch("roboneuron_fr3", ARM_JOINTS)
    stack.callback(watch.close)
    teleoperate(lerobot, config, "roboneuron_fr3")
    assert_swayed(watch.since(0.0))


@pytest.mark.skipif(not FCI_PYTHON.exists(), reason="franka-sim is missing: make .venv-fr3sim")
@pytest.mark.skipif(not is_importable("pylibfranka"), reason="pylibfranka is not installed here")
def test_an_arm_over_the_fci_is_teleoperated(
    lerobot: Lerobot, tmp_path: Path, stack: ExitStack
) -> None:
    sim = stack.enter_context(
        FrankaSim(FCI_PYTHON, options=["--enforce-motion-limits"], log=tmp_path / "sim.log")
    )
    config = tmp_path / "fci.toml"
    config.write_text(
        '[robot]\nname = "fr3"\ndriver = "fci"\n[control]\ncontroller = "urdf"\n'
        f'[plugins.fr3]\nhost = "{sim.host}"\nrealtime = "ignored"\n',
        encoding="utf-8",
    )
    ended = threading.Event()
    rows: list[list[float]] = []

    def look() -> None:
        while not ended.wait(0.05):
            rows.append(sim.tell()["joints"][:7])

    looking = threading.Thread(target=look)
    looking.start()
    try:
        # four periods, because on a busy machine control holds in some
        teleoperate(lerobot, config, "fr3", seconds=16)
    finally:
        ended.set()
        looking.join()
    # the simulator's own joints, in its own process
    assert_swayed(np.array(rows))
    assert np.abs(sim.tell()["velocities"]).max() < 1e-2
