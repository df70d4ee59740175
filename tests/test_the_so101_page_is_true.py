"""docs/so101.md: its file is accepted, simulated and with the arm; in its environment a checkpoint
of the form that the page describes drives the simulated arm.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest

from rn_backend_lerobot.options import LeRobotOptions
from rn_perception_camera.options import VideoCamerasOptions
from rn_robot_lerobot.lerobot_options import LerobotDriverOptions
from rn_robot_lerobot.profile import so101_profile
from rn_simulation.arm_options import SimulatedCamerasOptions
from rn_standard.console.parsers import whole_parser
from roboneuron.config import Config, parse_config

ROOT = Path(__file__).parents[1]
BIN = ROOT / ".venv-so101" / "bin"
PAGE = (ROOT / "docs" / "so101.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))
REPLACED = re.compile(
    r"^\[(robot|perception|plugins\.so101-sim-camera)\]\n(?:.+\n)+\n?", re.MULTILINE
)
COMMANDS = [
    shlex.split(line.partition("#")[0])[1:]
    for block in re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    for line in block.replace("\\\n", "").splitlines()
    if line.startswith("roboneuron")
]
TINY = """
from pathlib import Path
from rn_backend_lerobot.tiny import make_tiny
from rn_backend_lerobot.tiny_checkpoint import TinyShape
shape = TinyShape(width=640, height=480, means=(20.0, -10.0, 10.0, 50.0, 0.0, 50.0))
make_tiny(Path({folder!r}), "act", shape, seed=0)
"""
"""An ACT with the numbers of an SO-101: five joints [degrees] and a gripper [0 .. 100]."""


def checked(text: str) -> Config:
    """The configuration, its policy's options accepted."""
    config = parse_config(text)
    assert config.inference is not None
    told: dict[str, Any] = tomllib.loads(text)
    checkpoint = told["inference"]["checkpoint"]
    options = LeRobotOptions.model_validate(
        {"checkpoint": Path(checkpoint), **told["plugins"]["lerobot"]}
    )
    assert options.joints == (*so101_profile().arm_joints, "gripper_open")
    return config


def test_the_file_is_accepted_with_the_simulated_arm() -> None:
    config = checked(FILES["so101.toml"])
    SimulatedCamerasOptions.model_validate(config.plugins["so101-sim-camera"])


def test_the_file_is_accepted_with_the_arm_in_place_of_the_named_tables() -> None:
    rest, count = REPLACED.subn("", FILES["so101.toml"])
    assert count == 3
    config = checked(FILES["arm.toml"] + rest)
    LerobotDriverOptions.model_validate(config.plugins["so101"])
    cameras = VideoCamerasOptions.model_validate(config.plugins["video-camera"]).cameras
    assert set(cameras) == {camera.name for camera in so101_profile().cameras}


def test_its_commands_are_taken_by_the_parsers() -> None:
    assert len(COMMANDS) == 5
    for words in COMMANDS:
        whole_parser().parse_args(words)


@pytest.mark.ros
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(
    not (BIN.parent / ".ready").exists(), reason="its environment is not there: make .venv-so101"
)
def test_in_its_environment_a_checkpoint_drives_the_simulated_arm(
    tmp_path: Path, environment: dict[str, str]
) -> None:
    text = FILES["so101.toml"]
    (tmp_path / "so101.toml").write_text(text, encoding="utf-8")
    folder = tmp_path / tomllib.loads(text)["inference"]["checkpoint"]
    environment["PATH"] = f"{BIN}:{os.environ['PATH']}"
    make = [str(BIN / "python"), "-c", TINY.format(folder=str(folder))]
    subprocess.run(make, env=environment, check=True)
    check, run = (
        subprocess.run(
            [str(BIN / "roboneuron"), *next(one for one in COMMANDS if one[:1] == [first])],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        for first in ("config", "run")
    )
    assert check.returncode == 0, check.stdout + check.stderr
    assert run.returncode == 1, run.stdout + run.stderr  # random weights lift nothing
