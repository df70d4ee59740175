"""The whole way of a person who has a URDF: write, check, keep the contract, move in simulation.

A wall is put in the way; a judge with kinematics of its own says that the arm kept away from it.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from contract_run import contract_run
from urdf_samples import FINGERS, joint, link, write, write_box_mesh

from rn_testing.robot_judge import JudgedRobot
from roboneuron.cli.main import main

BALL = '<sphere radius="0.05"/>'
LIMIT = '<limit lower="-2.8" upper="2.8" velocity="2" effort="40"/>'
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
KEPT_M = 0.01
"""Least distance of the profile that is written."""
WALL = """
[[limits.obstacles]]
name = "wall"
lower_m = [-1.5, {near}, -1.0]
upper_m = [1.5, {far}, 2.0]
"""


def arm_of(first: str, count: int) -> list[str]:
    """Elements of an arm with fingers, whose third link has a mesh: kind of the first joint, and
    number of joints.
    """
    elements = [link("base_link")]
    for number, axis in enumerate(AXES[:count], 1):
        shape = '<mesh filename="package://arm/box.stl"/>' if number == 3 else BALL
        kind = first if number == 1 else "revolute"
        parent = "base_link" if number == 1 else f"l{number - 1}"
        elements += [
            link(f"l{number}", shape if number != 4 else ""),
            joint(f"j{number}", parent, f"l{number}", kind, more=LIMIT, axis=axis, xyz="0 0 0.2"),
        ]
    fingers = [element.replace("l3", f"l{count}") for element in FINGERS]
    return [*elements, link("tcp", ""), joint("mount", f"l{count}", "tcp", "fixed"), *fingers]


@pytest.fixture
def project(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """The package as the command wrote it, with metadata as pip would install them."""
    write_box_mesh(tmp_path / "arm" / "box.stl")
    urdf = write(tmp_path / "arm" / "urdf", *arm_of(*getattr(request, "param", ("revolute", 6))))
    project = tmp_path / "rn-robot-mine"
    words = ["plugins", "new", "robot", "mine", "--urdf", str(urdf), "--driver", "none"]
    assert main([*words, "--out", str(project)]) == 0
    info = project / "src" / "rn_robot_mine-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.4\nName: rn-robot-mine\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-robot-mine = rn_robot_mine.plugin\n")
    return project


def run(
    project: Path, environment: Mapping[str, str], *words: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "roboneuron.cli.main", *words],
        cwd=project,
        env={**environment, "PYTHONPATH": str(project / "src")},
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )


def moves(*goals: float) -> list[str]:
    words = ["call", "start_robot", "--config", "roboneuron.toml", "--then", "start_control", "{}"]
    for goal in goals:
        words += ["--then", "move_joints", json.dumps({"positions": {"j1": goal}})]
    return words


@pytest.mark.exhaustive
def test_the_written_arm_keeps_the_contract(project: Path) -> None:
    assert re.search(r"\d\d passed", contract_run(project, "TestMine", timeout_s=300.0))


@pytest.mark.ros
@pytest.mark.exhaustive
@pytest.mark.parametrize("project", [("revolute", 6), ("revolute", 5)], indirect=True, ids=str)
def test_the_written_arm_is_checked_and_moves_by_joint_and_by_its_tool(
    project: Path, environment: dict[str, str]
) -> None:
    checked = run(project, environment, "config", "check", "roboneuron.toml")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "not checked" not in checked.stdout
    text = (project / "FIRST_MOTION.md").read_text(encoding="utf-8")
    [first] = re.findall(r"--then move_joints '(.*)'", text)
    tool = json.dumps({"dx_m": 0.02, "dz_m": -0.02})
    words = [*moves(), "--then", "move_joints", first, "--then", "move_ee", tool]
    done = run(project, environment, *words)
    assert done.returncode == 0, done.stdout + done.stderr
    [(name, goal)] = json.loads(first)["positions"].items()
    [moved] = re.findall(rf'"{name}": (-?[\d.]+)', done.stdout)
    assert float(moved) == pytest.approx(goal, abs=0.01)
    [error_m] = re.findall(r'"error_m": ([^,]+),', done.stdout)
    assert float(error_m) < 0.002


@pytest.mark.ros
@pytest.mark.exhaustive
@pytest.mark.parametrize("project", [("revolute", 6), ("continuous", 6)], indirect=True, ids=str)
def test_a_wall_in_the_way_is_kept_away_from_by_another_judge(
    project: Path, environment: dict[str, str]
) -> None:
    urdf = (project / "src" / "rn_robot_mine" / "mine.urdf").read_text(encoding="utf-8")
    judge = JudgedRobot(urdf)
    home = _home(project)
    reach_m = max(_sides(judge, home))
    wall = WALL.format(near=round(0.6 * reach_m, 3), far=2.0)
    config = project / "roboneuron.toml"
    config.write_text(config.read_text(encoding="utf-8") + wall, encoding="utf-8")
    bounds = tomllib.loads(wall)["limits"]["obstacles"][0]
    lower, upper = (np.array(bounds[name]) for name in ("lower_m", "upper_m"))

    def apart_m(angle: float) -> float:
        there = {**home, "j1": angle}
        balls = [name for name, spheres in judge.spheres.items() if spheres and name != "base_link"]
        return min(judge.box_distance(b, there, "base_link", lower, upper) for b in balls)

    assert apart_m(0.3) > KEPT_M
    assert apart_m(1.5) < 0.0, "the goal of the second motion is in the wall"
    done = run(project, environment, *moves(0.3, 1.5))
    told = done.stdout + done.stderr
    assert done.returncode != 0, told
    assert re.search(r"\w+ and wall", told), told
    reached = [float(value) for value in re.findall(r'"j1": (-?[\d.]+)', done.stdout)]
    assert reached[0] == pytest.approx(0.3, abs=0.01), told
    assert all(apart_m(angle) > KEPT_M - 1e-3 for angle in reached)


def _home(project: Path) -> dict[str, float]:
    """Home as the checklist tells it."""
    text = (project / "FIRST_MOTION.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in text.splitlines() if re.match(r"\| j\d", line)]
    return {row[1].strip(): float(row[2]) for row in rows}


def _sides(judge: JudgedRobot, home: Mapping[str, float]) -> list[float]:
    """How far each link with balls is from the axis of the first joint [m]."""
    poses = [judge.pose(name, home, "base_link") for name, balls in judge.spheres.items() if balls]
    return [float(np.hypot(*pose[:2, 3])) for pose in poses]
