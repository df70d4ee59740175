"""docs/tutorials/your-own-arm.md: its files make a package that keeps the contract, and its arm
moves.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from pathlib import Path

import pytest
from contract_run import contract_run

from roboneuron.cli.main import main

PAGE = (Path(__file__).parents[1] / "docs" / "tutorials" / "your-own-arm.md").read_text(
    encoding="utf-8"
)
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE, flags=re.DOTALL))

STRICT = ("-W", "error")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """The package of the page, with metadata as pip would install them."""
    project = tmp_path / "rn-robot-myarm"
    assert main(["new", "robot", "myarm", "--directory", str(project)]) == 0
    for name, text in FILES.items():
        (project / name).write_text(text, encoding="utf-8")
    info = project / "src" / "rn_robot_myarm-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.4\nName: rn-robot-myarm\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-robot-myarm = rn_robot_myarm.plugin\n")
    return project


def test_the_page_has_all_files() -> None:
    names = ("myarm.urdf", "profile.py", "ros2.py", "plugin.py")
    assert set(FILES) == {
        "roboneuron.toml",
        "fake_arm.py",
        *(f"src/rn_robot_myarm/{name}" for name in names),
    }


@pytest.mark.exhaustive
def test_the_arm_of_the_page_keeps_its_contract(project: Path) -> None:
    assert re.search(
        r"\d\d passed", contract_run(project, "TestMyarm", options=STRICT, timeout_s=300.0)
    )


@pytest.mark.ros
@pytest.mark.parametrize(
    "driver",
    [
        pytest.param("simulated", marks=pytest.mark.exhaustive),
        pytest.param("ros2", marks=pytest.mark.slow),
    ],
)
def test_the_arm_of_the_page_moves(project: Path, environment: dict[str, str], driver: str) -> None:
    environment = {**environment, "PYTHONPATH": str(project / "src")}
    config = project / "roboneuron.toml"
    config.write_text(
        FILES["roboneuron.toml"].replace("[robot]", f'[robot]\ndriver = "{driver}"'),
        encoding="utf-8",
    )
    arm = subprocess.Popen(
        [sys.executable, "fake_arm.py"], cwd=project, env=environment, stderr=subprocess.DEVNULL
    )
    command = [
        "roboneuron",
        "call",
        "start_robot",
        "--config",
        str(config),
        "--then",
        "start_control",
        "{}",
    ]
    command += ["--then", "move_joints", '{"positions": {"joint_1": 0.3}}']
    command += ["--then", "move_ee", '{"dx_m": 0.05, "dz_m": -0.05}']
    try:
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, timeout=180, check=False
        )
    finally:
        arm.kill()
        arm.wait(10)
    assert done.returncode == 0, done.stdout + done.stderr
    [moved] = re.findall(r'"joint_1": ([\d.]+)', done.stdout)
    assert abs(float(moved) - 0.3) < 0.01  # return value of move_joints
    [error_m] = re.findall(r'"error_m": ([^,]+),', done.stdout)
    assert float(error_m) < 0.002  # return value of move_ee; may well be 0.0 or 2e-05


WALL = """
[[limits.obstacles]]
name = "wall"
lower_m = [-1.0, 0.39, -1.0]
upper_m = [1.0, 0.6, 1.5]
"""


@pytest.mark.exhaustive
@pytest.mark.ros
@pytest.mark.parametrize(
    "kind", ["continuous", pytest.param("revolute", marks=pytest.mark.exhaustive)]
)
def test_a_wall_stops_an_arm_whose_first_joint_turns_without_end(
    project: Path, environment: dict[str, str], kind: str
) -> None:
    """As it does one with end stops; and a goal beyond half a turn is reached the shorter way."""
    environment = {**environment, "PYTHONPATH": str(project / "src")}
    urdf, profile = (project / "src" / "rn_robot_myarm" / n for n in ("myarm.urdf", "profile.py"))
    text = urdf.read_text(encoding="utf-8")
    named = 'name="joint_1" type="revolute"'
    assert named in text
    urdf.write_text(text.replace(named, f'name="joint_1" type="{kind}"'), encoding="utf-8")
    if kind == "continuous":
        text = profile.read_text(encoding="utf-8")
        endless = text.replace(
            "            lower=-upper,\n            upper=upper,\n",
            "            lower=np.append(-np.inf, -upper[1:]),\n"
            "            upper=np.append(np.inf, upper[1:]),\n",
        )
        box = "[0.15, -0.5, 0.05]"  # the workspace, which is in front of the arm
        assert box in endless
        endless = endless.replace(box, "[-0.75, -0.75, 0.05]")
        assert endless.count("np.inf") == 2
        profile.write_text(endless, encoding="utf-8")
    config = project / "roboneuron.toml"
    config.write_text(FILES["roboneuron.toml"] + WALL, encoding="utf-8")
    command = ["roboneuron", "call", "start_robot", "--config", str(config)]
    goals = [-0.4, 1.2]
    if kind == "continuous":
        goals = [-1.5, -2.9, 3.2, 1.2]  # 3.2 is -3.08: past the half turn, not past the wall
    for goal in goals:
        command += ["--then", "move_joints", f'{{"positions": {{"joint_1": {goal}}}}}']
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    told = done.stdout + done.stderr
    assert done.returncode != 0, told
    assert re.search(r"(forearm|upper_arm) and wall", told), told
    moved = [float(value) for value in re.findall(r'"joint_1": (-?[\d.]+)', done.stdout)]
    expected = goals[:-1] if kind == "revolute" else [-1.5, -2.9, 3.2 - 2 * math.pi]
    assert moved == pytest.approx(expected, abs=0.01), told


@pytest.mark.ros
def test_an_arm_whose_distances_are_not_checked_says_so_wherever_it_is_started(
    project: Path, environment: dict[str, str]
) -> None:
    environment = {**environment, "PYTHONPATH": str(project / "src")}
    profile = project / "src" / "rn_robot_myarm" / "profile.py"
    text = profile.read_text(encoding="utf-8")
    asks = "        collision=CollisionProfile(min_distance_m=0.01),"
    assert asks in text
    profile.write_text(text.replace(asks, "        #"), encoding="utf-8")
    config = project / "roboneuron.toml"
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
