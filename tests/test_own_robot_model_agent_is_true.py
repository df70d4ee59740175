"""docs/own-robot-model-agent.md: its files and commands, typed in order, lead from a URDF to
motions by an agent and by a policy.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import anyio
import cv2
import numpy as np
import pytest
from mcp import Client, StdioServerParameters

from rn_backend_openpi.server_options import PolicyServerOptions
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_testing.spinning import spinning_node
from rn_testing.waiting import wait_until
from roboneuron.cli.main import main
from roboneuron.config import load_config
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover
from roboneuron.ros.environment import prepare_environment

DOCS = Path(__file__).parents[1] / "docs"
FILE = re.compile(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", re.DOTALL)
PAGE = (DOCS / "own-robot-model-agent.md").read_text(encoding="utf-8")
FILES = dict(FILE.findall(PAGE))
URDF = (DOCS.parent / "examples" / "myarm.urdf").read_text(encoding="utf-8")
COMMANDS = [
    line.partition("#")[0].strip()
    for block in re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
    for line in block.replace("\\\n", "").splitlines()
    if line.startswith("roboneuron")
]
FILM = 'path = "desk.mp4"\nloop = true\n'


def typed(start: str) -> list[str]:
    """The page's command that starts like this, without the program."""
    return shlex.split(next(one for one in COMMANDS if one.startswith(f"roboneuron {start}")))[1:]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The reader's folder after step 2."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "myarm.urdf").write_text(URDF, encoding="utf-8")
    (tmp_path / "roboneuron.toml").write_text(FILES["roboneuron.toml"], encoding="utf-8")
    return tmp_path


@pytest.fixture
def package(folder: Path, environment: dict[str, str]) -> Path:
    """Package of step 5, with metadata as pip would install them, and a film for the camera."""
    assert main(typed("plugins new backend")) == 0
    source = folder / "rn-backend-my-policy" / "src"
    info = source / "rn_backend_my_policy-0.1.0.dist-info"
    info.mkdir()
    name = "rn-backend-my-policy"
    (info / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[roboneuron]\n{name} = rn_backend_my_policy.plugin\n")
    environment["PYTHONPATH"] = str(source)
    film = cv2.VideoWriter("desk.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 10, (64, 48))
    for grey in range(0, 200, 10):
        film.write(np.full((48, 64, 3), grey, np.uint8))
    film.release()
    return source


def add(folder: Path, *names: str) -> None:
    """Append files of the page; a film stands in for the device."""
    text = "".join(FILES[name] for name in ("roboneuron.toml", *names))
    film = re.sub(r"^device = 0 .*\n", FILM, text, flags=re.MULTILINE)
    (folder / "roboneuron.toml").write_text(film, encoding="utf-8")


def run(words: Sequence[str], environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["roboneuron", *words],
        env=environment,
        capture_output=True,
        text=True,
        timeout=170,
        check=False,
    )


def test_each_file_of_the_page_is_accepted(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(typed("config arm")) == 0
    assert main(typed("config check")) == 0
    assert "joint_1" in capsys.readouterr().out
    add(folder, "camera.toml", "served.toml")
    assert main(typed("config check")) == 0
    PolicyServerOptions.model_validate(tomllib.loads(FILES["policies.toml"]))


def test_the_real_arm_needs_only_the_lines_of_the_page(folder: Path) -> None:
    tables = FILES["roboneuron.toml"].partition("\n[control]")
    (folder / "roboneuron.toml").write_text(FILES["real.toml"] + "".join(tables[1:]))
    config = load_config(folder / "roboneuron.toml")
    check_configuration(config, discover(config.disabled_plugins, config.robot))
    Ros2ControlOptions.model_validate(config.plugins["myarm"])


@pytest.mark.ros
def test_the_agents_block_launches_a_server_that_moves_the_joint(
    folder: Path, environment: dict[str, str]
) -> None:
    entry = json.loads(FILES["mcp.json"])["mcpServers"]["myarm"]
    parameters = StdioServerParameters(
        command=entry["command"], args=entry["args"], env=environment, cwd=folder
    )
    asked = typed("call start_robot")

    async def moved() -> Any:
        async with Client(parameters) as client:
            for module in ("start_robot", "start_control"):
                started = await client.call_tool(module, {})
                assert not started.is_error, started
            told = await client.call_tool("move_joints", json.loads(asked[-1]))
            assert not told.is_error, told
            return told.structured_content

    assert anyio.run(moved)["position"] == pytest.approx({"joint_1": 0.3}, abs=0.01)


@pytest.fixture
def joints(
    environment: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[list[list[float]]]:
    """Measured positions that the arm has published so far."""
    monkeypatch.setenv("ROS_DOMAIN_ID", environment["ROS_DOMAIN_ID"])
    prepare_environment(tmp_path / "state" / "roboneuron")
    from sensor_msgs.msg import JointState

    from roboneuron.ros.qos import NEWEST

    seen: list[list[float]] = []
    with spinning_node("myarm") as node:
        node.create_subscription(
            JointState, "joint_states", lambda message: seen.append(list(message.position)), NEWEST
        )
        yield seen


MOVED_RAD = 0.01
"""The policy moves 1 mm along x every 0.1 s; the home posture holds within far less."""


@pytest.mark.ros
@pytest.mark.slow
def test_the_commands_of_the_page_move_the_arm_by_hand_and_by_the_policy(
    folder: Path, package: Path, environment: dict[str, str], joints: list[list[float]]
) -> None:
    by_hand = run(typed("call start_robot"), environment)
    assert by_hand.returncode == 0, by_hand.stdout + by_hand.stderr
    assert np.ptp(np.array(joints), axis=0)[0] == pytest.approx(0.3, abs=0.01)
    joints.clear()
    add(folder, "camera.toml", "model.toml")
    by_policy = run(typed("run"), environment)
    assert by_policy.returncode == 3, by_policy.stdout + by_policy.stderr
    assert np.ptp(np.array(joints), axis=0).max() > MOVED_RAD


@pytest.mark.ros
@pytest.mark.slow
def test_the_policy_moves_the_arm_from_a_server_of_its_own(
    folder: Path, package: Path, environment: dict[str, str], joints: list[list[float]]
) -> None:
    (folder / "policies.toml").write_text(FILES["policies.toml"], encoding="utf-8")
    add(folder, "camera.toml", "served.toml")
    told = folder / "server.log"
    with told.open("w") as log:
        words = ["roboneuron", *typed("policy serve")]
        server = subprocess.Popen(words, env=environment, stdout=log, stderr=log)
    try:
        wait_until(lambda: "The model mine is ready" in told.read_text(), 90.0)
        by_policy = run(typed("run"), environment)
    finally:
        server.terminate()
        server.wait(30)
    assert by_policy.returncode == 3, by_policy.stdout + by_policy.stderr
    assert np.ptp(np.array(joints), axis=0).max() > MOVED_RAD
