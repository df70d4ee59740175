"""The package that `roboneuron plugins new robot NAME --urdf` writes: limits, shapes, home."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from urdf_samples import ARM, BALL, FINGERS, LIMIT, joint, link, robot, write, write_box_mesh

from rn_standard.declared_arm.arm_draft import ArmDraft, draft_arm
from rn_standard.declared_arm.urdf_guesses import Chosen
from rn_testing.robot_judge import JudgedRobot
from roboneuron import ConfigurationError, RobotProfile
from roboneuron.cli.main import main

APART_M = 0.01
SIDEWAYS = joint("stand", "world", "base_link", "fixed", xyz='0 0 0" rpy="1.5 0 0')
"""The arm is mounted at a wall."""


def draft(folder: Path, *elements: str, **options: object) -> ArmDraft:
    return draft_arm("sample", write(folder, *elements), chosen=Chosen(), **options)


def refusal(folder: Path, *elements: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        draft(folder, *elements)
    return str(caught.value)


def changed(old: str, new: str) -> tuple[str, ...]:
    """`ARM` with another text in its first joint."""
    assert old in ARM[5]
    return (*ARM[:5], ARM[5].replace(old, new), *ARM[6:])


def new(tmp_path: Path, *words: str) -> Path:
    """The folder of a new package."""
    made = tmp_path / "made"
    urdf = str(tmp_path / "sample.urdf")
    assert (
        main(["plugins", "new", "robot", "sample", "--urdf", urdf, "--out", str(made), *words]) == 0
    )
    return made


def profile_of(made: Path, monkeypatch: pytest.MonkeyPatch) -> RobotProfile:
    """The profile that a package builds."""
    monkeypatch.syspath_prepend(str(made / "src"))
    monkeypatch.delitem(sys.modules, "rn_robot_sample", raising=False)  # that of another test
    where = made / "src" / "rn_robot_sample" / "profile.py"
    spec = importlib.util.spec_from_file_location("sample_profile", where)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    profile = module.build_profile()
    assert isinstance(profile, RobotProfile)
    return profile


@pytest.mark.parametrize(
    ("limit", "velocity", "effort", "words"),
    [
        (LIMIT, 1.5, 30.0, ("acceleration",)),
        ('<limit lower="-2" upper="2" effort="30"/>', 0.5, 30.0, ("acceleration", "velocity")),
        ('<limit lower="-2" upper="2" velocity="1.5"/>', 1.5, 1.0, ("acceleration", "effort")),
        (
            '<limit lower="-2" upper="2" velocity="0" effort="0"/>',
            *(0.5, 1.0, ("acceleration", "velocity", "effort")),
        ),
    ],
)
def test_limits_that_the_urdf_lacks_are_careful_and_named(tmp_path, limit, velocity, effort, words):
    made = draft(tmp_path, *changed(LIMIT, limit))
    row = made.limits[0]
    assert (row.velocity, row.effort) == (velocity, effort)
    assert row.acceleration == 2.0 * velocity
    assert tuple(note.split()[0].rstrip(":") for note in made.notes) == words


@pytest.mark.parametrize(
    "limit", ["", '<limit velocity="1" effort="9"/>', LIMIT.replace("-2", "2")]
)
def test_joints_without_a_range_are_refused_together(tmp_path, limit):
    elements = [e.replace(LIMIT, limit) for e in ARM]
    told = refusal(tmp_path, *elements)
    assert all(name in told for name in ("j1", "j2", "j3", "lower", "continuous")), told


def test_a_continuous_joint_needs_no_range(tmp_path, monkeypatch):
    write(tmp_path, *changed('"revolute">', '"continuous">'), *FINGERS)
    limits = profile_of(new(tmp_path), monkeypatch).limits
    assert limits is not None
    assert (limits.lower[0], limits.upper[0]) == (-math.inf, math.inf)


def test_home_is_free_of_contact_and_away_from_limits_by_another_judge(tmp_path):
    made = draft(tmp_path, *ARM)
    home = dict(zip(made.parts.joints, made.home.position.tolist(), strict=True))
    for row in made.limits:
        room = 0.1 * (row.upper - row.lower)
        assert row.lower + room <= home[row.joint] <= row.upper - room
    judge = JudgedRobot(robot(*ARM))
    pairs = [("base_link", "l2"), ("base_link", "l3"), ("l1", "l3")]
    apart = [judge.distance(one, other, home) for one, other in pairs]
    assert min(apart) > APART_M
    nearest = made.home.nearest
    told = {(pair.first, pair.second): pair.distance_m for pair in nearest}
    for pair, distance_m in zip(pairs, apart, strict=True):
        assert told.get(pair, distance_m) == pytest.approx(distance_m, abs=1e-6)


def test_home_is_the_same_each_time(tmp_path):
    first, second = (draft(tmp_path, *ARM).home for _ in range(2))
    assert first.position.tolist() == second.position.tolist()


def test_the_floor_is_an_obstacle_unless_the_arm_would_touch_it(tmp_path):
    standing = draft(tmp_path, *ARM)
    hanging = [e.replace('xyz="0 0 0.25"', 'xyz="0 0 -0.25"') for e in ARM]
    assert standing.home.has_floor
    assert not draft(tmp_path, *hanging).home.has_floor


def test_shapes_that_touch_in_every_posture_are_named(tmp_path):
    wide = [e.replace(BALL, '<sphere radius="0.6"/>') if 'name="l1"' in e else e for e in ARM]
    assert ("l1", "l3") in draft(tmp_path, *wide).home.overlapping


def test_an_arm_without_shapes_says_that_nothing_is_checked(tmp_path, monkeypatch):
    made = draft(tmp_path, *(e.replace(f"<geometry>{BALL}</geometry>", "") for e in ARM))
    assert made.home.unchecked
    assert any("NOT CHECKED" in line for line in made.report())
    assert profile_of(new(tmp_path), monkeypatch).collision is None


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("package://arm_msgs/meshes/box.stl", "arm_msgs/meshes/box.stl"),
        ("meshes/box.stl", "urdf/meshes/box.stl"),
        ("../meshes/box.stl", "meshes/box.stl"),
        ("package://arm_msgs/meshes/box.stl", "elsewhere/arm_msgs/meshes/box.stl"),
    ],
)
def test_meshes_are_copied_and_count_for_distances(tmp_path, monkeypatch, name, place):
    write_box_mesh(tmp_path / place)
    mesh = f'<mesh filename="{name}"/>'
    elements = [e.replace(BALL, mesh) for e in ARM]
    urdf = write(tmp_path / "urdf", *elements)
    made = tmp_path / "made"
    words = ["plugins", "new", "robot", "sample", "--urdf", str(urdf), "--out", str(made)]
    assert main([*words, "--package-path", str(tmp_path / "elsewhere")]) == 0
    (tmp_path / place).unlink()  # the package stands alone
    profile = profile_of(made, monkeypatch)
    assert (Path(profile.mesh_folder) / "meshes" / "box.stl").is_file()
    assert profile.collision is not None
    assert not profile.why_unchecked(_Asked())


class _Asked:
    """Nothing of `[limits]` is given."""

    collision, min_distance_m, obstacles = True, None, None


def test_a_mesh_without_a_file_is_named_and_left_out(tmp_path):
    lost = '<mesh filename="package://arm/lost.stl"/>'
    elements = [e.replace(BALL, lost) if 'name="l3"' in e else e for e in ARM]
    made = draft(tmp_path, *elements)
    assert made.shapes.missing == ("package://arm/lost.stl",)
    assert made.shapes.bare == ("l3",)
    assert "mesh" not in made.shapes.urdf
    assert any("lost.stl" in line for line in made.report())


def test_links_without_collision_shapes_borrow_those_for_display(tmp_path):
    shown = [link(f"l{i}", BALL, "visual") if f'name="l{i}"' in e else e for i, e in enumerate(ARM)]
    made = draft(tmp_path, *shown)
    assert made.shapes.borrowed == ("l1", "l2", "l3")
    links = ElementTree.fromstring(made.shapes.urdf).findall("link")
    assert all(one.find("collision") is not None for one in links if one.get("name") != "tcp")


def test_two_meshes_of_one_name_stay_two(tmp_path):
    write_box_mesh(tmp_path / "visual" / "box.stl", 0.02)
    write_box_mesh(tmp_path / "collision" / "box.stl", 0.03)
    shapes = "".join(
        f'<{role}><geometry><mesh filename="{role}/box.stl"/></geometry></{role}>'
        for role in ("visual", "collision")
    )
    elements = [f'<link name="l3">{shapes}</link>' if 'link name="l3"' in e else e for e in ARM]
    assert len(set(draft(tmp_path, *elements).shapes.files.values())) == 2


@pytest.mark.parametrize("driver", ["none", "ros2-control", "lerobot"])
def test_the_configuration_is_slow_and_names_the_driver(tmp_path, driver):
    write(tmp_path, *ARM, *FINGERS)
    made = new(tmp_path, "--driver", driver)
    text = (made / "roboneuron.toml").read_text(encoding="utf-8")
    config = tomllib.loads(text)
    assert config["robot"] == {"name": "sample", "driver": "simulated"}
    assert config["limits"]["velocity_fraction"] == 0.1
    assert config["limits"]["obstacles"][0]["name"] == "floor"
    assert config["plugins"]["urdf"]["track"] == "position", "it has three joints"
    plugin = (made / "src" / "rn_robot_sample" / "plugin.py").read_text(encoding="utf-8")
    assert (f'name="{driver}"' in plugin) == (driver != "none")
    assert ("[plugins.sample]" in text) == (driver != "none")
    assert "# source = " in text, "a camera to fill in"


@pytest.mark.parametrize("stand", [(), (link("world", ""), SIDEWAYS)])
def test_the_checklist_names_each_joint_with_its_axis_in_the_base_frame(tmp_path, stand):
    write(tmp_path, *ARM, *FINGERS, *stand)
    text = (new(tmp_path) / "FIRST_MOTION.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| j")]
    assert [row[1].strip() for row in rows[1:]] == ["j1", "j2", "j3"]
    assert "(0.00, 0.00, 1.00)" in rows[1][3]
    assert "slide" in text, "the gripper that was guessed"


def test_the_written_package_is_formatted_and_free_of_lint(tmp_path):
    elements = changed('"revolute">', '"continuous">')
    write(tmp_path, *elements, *FINGERS)
    made = new(tmp_path, "--driver", "ros2-control")
    for words in (["check"], ["format", "--check"]):
        done = subprocess.run(
            [sys.executable, "-m", "ruff", *words, "--no-cache", str(made)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["backend", "x", "--urdf", "sample.urdf"], "--urdf"),
        (["robot", "x", "--tcp", "tcp"], "--tcp"),
        (["robot", "x", "--urdf", "gone.urdf"], "gone.urdf"),
        (["robot", "x", "--urdf", "sample.urdf", "--driver", "fci"], "fci"),
        (["robot", "X!", "--urdf", "sample.urdf"], "X!"),
    ],
)
def test_options_that_do_not_fit_are_refused_and_nothing_is_written(
    tmp_path, monkeypatch, capsys, words, name
):
    write(tmp_path, *ARM)
    monkeypatch.chdir(tmp_path)
    assert main(["plugins", "new", *words]) == 2
    assert name in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sample.urdf"]


def test_no_posture_without_contact_is_refused_with_the_links(tmp_path):
    """Two walls as balls, of which the tip of the arm is in one or the other."""
    walls = [
        element
        for name, x in (("front", 0.6), ("back", -0.6))
        for element in (
            link(name, '<sphere radius="0.6"/>'),
            joint(f"to_{name}", "l1", name, "fixed", xyz=f"{x} 0 0.4"),
        )
    ]
    told = refusal(tmp_path, *ARM, *walls)
    assert "l3" in told
    assert "front" in told or "back" in told
