"""docs/tutorials/your-own-arm.md: its command makes a package whose arm moves, simulated and behind
a stand-in of ros2_control.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from roboneuron.cli.main import main
from roboneuron.config import load_config
from roboneuron.modules.plugin import load_profile
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover

PAGE = (Path(__file__).parents[1] / "docs" / "tutorials" / "your-own-arm.md").read_text(
    encoding="utf-8"
)
URDF = (Path(__file__).parents[1] / "examples" / "myarm.urdf").read_text(encoding="utf-8")
LINES = PAGE.replace("\\\n", "")
"""The page with continued lines joined."""
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE, flags=re.DOTALL))
[CREATE] = re.findall(r"^roboneuron (plugins new robot .*)$", PAGE, flags=re.MULTILINE)
[CALLS] = re.findall(r"\$ roboneuron (call .*?)```", LINES, flags=re.DOTALL)
[REAL] = re.findall(r"```toml\n(\[robot\].*?)```", PAGE, flags=re.DOTALL)
[STAND_IN] = re.findall(r"^roboneuron (robot stand-in .*)$", PAGE, flags=re.MULTILINE)
CONTROL_PAGE = (Path(__file__).parents[1] / "docs" / "ros2-control.md").read_text(encoding="utf-8")
EIGHT_LINES = re.findall(r"```toml\n(\[robot\].*?)```", CONTROL_PAGE, flags=re.DOTALL)[0]
"""The configuration of any arm behind ros2_control."""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package of the page, with metadata as pip would install them."""
    (tmp_path / "myarm.urdf").write_text(URDF, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(CREATE)) == 0
    project = tmp_path / "rn-robot-myarm"
    info = project / "src" / "rn_robot_myarm-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.4\nName: rn-robot-myarm\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-robot-myarm = rn_robot_myarm.plugin\n")
    return project


def run(
    project: Path, environment: dict[str, str], words: str | list[str]
) -> subprocess.CompletedProcess[str]:
    """A command of the page, as its reader types it."""
    return subprocess.run(
        ["roboneuron", *(shlex.split(words) if isinstance(words, str) else words)],
        cwd=project,
        env={**environment, "PYTHONPATH": str(project / "src")},
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )


def test_the_page_has_its_files_and_the_command_writes_what_it_says(project: Path) -> None:
    assert set(FILES) == {"wall.toml"}
    named = set(re.findall(r"^- `([^`]+)`", PAGE, flags=re.MULTILINE))
    assert named >= {"src/rn_robot_myarm/profile.py", "roboneuron.toml", "FIRST_MOTION.md"}
    assert all((project / name).exists() for name in named)


def test_eight_lines_of_toml_are_an_arm_behind_ros2_control(tmp_path: Path) -> None:
    assert len(EIGHT_LINES.splitlines()) == 8
    (tmp_path / "myarm.urdf").write_text(URDF, encoding="utf-8")
    (tmp_path / "roboneuron.toml").write_text(EIGHT_LINES, encoding="utf-8")
    config = load_config(tmp_path / "roboneuron.toml")
    registry = discover(config.disabled_plugins, config.robot)
    check_configuration(config, registry)
    profile = load_profile(registry, config.robot)
    assert profile.arm_joints == tuple(f"joint_{number}" for number in range(1, 7))
    assert profile.home_rad is not None
    assert profile.collision is not None


@pytest.mark.exhaustive
@pytest.mark.ros
def test_the_simulated_arm_of_the_page_moves_and_stays_away_from_its_wall(
    project: Path, environment: dict[str, str]
) -> None:
    checked = run(project, environment, "config check roboneuron.toml")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert checked.stdout.strip() in PAGE
    done = run(project, environment, CALLS)
    assert done.returncode == 0, done.stdout + done.stderr
    [moved] = re.findall(r'"joint_1": ([\d.]+)', done.stdout)
    assert abs(float(moved) - 0.3) < 0.01  # return value of move_joints
    [error_m] = re.findall(r'"error_m": ([^,]+),', done.stdout)
    assert float(error_m) < 0.002  # return value of move_ee; may well be 0.0 or 2e-05
    config = project / "roboneuron.toml"
    config.write_text(config.read_text(encoding="utf-8") + FILES["wall.toml"], encoding="utf-8")
    goal = json.dumps({"positions": {"joint_1": 1.5}})
    words = ["call", "start_robot", "--config", "roboneuron.toml"]
    stopped = run(project, environment, [*words, "--then", "move_joints", goal])
    assert stopped.returncode != 0, stopped.stdout + stopped.stderr
    assert re.search(r"\w+ and wall", stopped.stdout + stopped.stderr)


@pytest.mark.ros
@pytest.mark.slow
def test_the_arm_of_the_page_moves_behind_ros2_control(
    project: Path, environment: dict[str, str]
) -> None:
    config = project / "roboneuron.toml"
    text = config.read_text(encoding="utf-8")
    robot, rest = text[: text.index("[robot]")], text[text.index("[control]") :]
    config.write_text(robot + REAL + rest, encoding="utf-8")
    arm = subprocess.Popen(
        ["roboneuron", *shlex.split(STAND_IN)],
        cwd=project,
        env={**environment, "PYTHONPATH": str(project / "src")},
        stderr=subprocess.DEVNULL,
    )
    try:
        done = run(project, environment, CALLS)
    finally:
        arm.kill()
        arm.wait(10)
    assert done.returncode == 0, done.stdout + done.stderr
    [moved] = re.findall(r'"joint_1": ([\d.]+)', done.stdout)
    assert abs(float(moved) - 0.3) < 0.01


@pytest.mark.ros
def test_an_arm_whose_distances_are_not_checked_says_so_wherever_it_is_started(
    project: Path, environment: dict[str, str]
) -> None:
    environment = {**environment, "PYTHONPATH": str(project / "src")}
    profile = project / "src" / "rn_robot_myarm" / "profile.py"
    text = profile.read_text(encoding="utf-8")
    asks = "collision=CollisionProfile(min_distance_m=0.01),"
    assert asks in text
    profile.write_text(text.replace(asks, "collision=None,"), encoding="utf-8")
    config = project / "unchecked.toml"
    config.write_text('[robot]\nname = "myarm"\n[control]\ncontroller = "urdf"\n', encoding="utf-8")
    commands = {
        "config check": ["config", "check", str(config)],
        "calls": [
            *("call", "start_robot", "--config", str(config)),
            *("--then", "start_control", "{}", "--then", "get_status", "{}"),
        ],
    }
    told = {}
    for name, command in commands.items():
        done = subprocess.run(
            ["roboneuron", *command],
            env=environment,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        told[name] = done.stdout.count("Distances between the links of 'myarm', and to obstacles,")
        assert "Set min_distance_m = 0.01 in [limits]." in done.stdout
    assert told == {"config check": 1, "calls": 3}, "start_robot, start_control and get_status"
