"""`[robot.arm]`: an arm without a package, read as by `roboneuron plugins new robot --urdf`."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
from urdf_samples import ARM, FINGERS, write, write_box_mesh

from roboneuron import ConfigurationError, PlanningError, RobotProfile
from roboneuron.cli.main import main
from roboneuron.config import Config, ModuleSettings, load_config
from roboneuron.modules.plugin import load_profile
from roboneuron.planning import check_configuration
from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import RobotSpec
from roboneuron.selection.choosing import choose
from roboneuron.selection.requests import StartRobot

LINES = """\
[robot]
name = "mine"
driver = "{driver}"
arm.urdf = "sample.urdf"
{more}
[control]
controller = "urdf"
"""


def config_of(folder: Path, more: str = "", driver: str = "simulated") -> Config:
    path = folder / "roboneuron.toml"
    path.write_text(LINES.format(driver=driver, more=more), encoding="utf-8")
    return load_config(path)


def registry_of(config: Config) -> Registry:
    return discover(config.disabled_plugins, config.robot)


def profile_of(folder: Path, more: str = "") -> RobotProfile:
    config = config_of(folder, more)
    return load_profile(registry_of(config), config.robot.name)


def refusal(folder: Path, more: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        profile_of(folder, more)
    return str(caught.value)


def written_profile(folder: Path, monkeypatch: pytest.MonkeyPatch) -> RobotProfile:
    """The profile of the package that the command writes for the same URDF."""
    made = folder / "made"
    words = ["plugins", "new", "robot", "mine", "--urdf", str(folder / "sample.urdf")]
    assert main([*words, "--driver", "ros2-control", "--out", str(made)]) == 0
    monkeypatch.syspath_prepend(str(made / "src"))
    profile = importlib.import_module("rn_robot_mine.profile").build_profile()
    assert isinstance(profile, RobotProfile)
    return profile


def test_it_is_the_arm_that_the_command_would_write(tmp_path, monkeypatch):
    write(tmp_path, *ARM, *FINGERS)
    declared, written = profile_of(tmp_path), written_profile(tmp_path, monkeypatch)
    for name in ("base_link", "tcp_link", "arm_joints", "gripper", "endpoints", "arms"):
        assert getattr(declared, name) == getattr(written, name), name
    assert declared.limits is not None
    assert written.limits is not None
    for name in ("lower", "upper", "velocity", "acceleration", "effort"):
        one, other = getattr(declared.limits, name), getattr(written.limits, name)
        assert one.tolist() == other.tolist(), name
    assert declared.home_rad == pytest.approx(written.home_rad)
    assert [camera.name for camera in declared.cameras] == ["front"]
    assert declared.collision is not None
    assert written.collision is not None
    assert declared.collision.min_distance_m == written.collision.min_distance_m
    assert [body.name for body in declared.collision.obstacles] == ["floor"]


@pytest.mark.parametrize("driver", ["simulated", "ros2-control"])
def test_a_configuration_with_it_fits_the_installed_plugins(tmp_path, driver):
    write(tmp_path, *ARM)
    config = config_of(tmp_path, driver=driver)
    check_configuration(config, registry_of(config))


def test_a_driver_that_does_not_exist_is_refused_with_those_that_do(tmp_path):
    write(tmp_path, *ARM)
    config = config_of(tmp_path, driver="mine")
    with pytest.raises(PlanningError, match=r"simulated, ros2-control, lerobot, fci"):
        check_configuration(config, registry_of(config))


def test_module_processes_get_the_same_arm(tmp_path):
    write(tmp_path / "descriptions", *ARM)
    (tmp_path / "roboneuron.toml").write_text(
        LINES.format(driver="simulated", more="").replace("sample", "descriptions/sample"),
        encoding="utf-8",
    )
    config = load_config(tmp_path / "roboneuron.toml")
    settings = ModuleSettings(kind="robot", node_name="robot", config=config)
    there = ModuleSettings.model_validate_json(settings.model_dump_json()).config
    profiles = [load_profile(registry_of(one), "mine") for one in (config, there)]
    assert profiles[0].home_rad == pytest.approx(profiles[1].home_rad)
    assert profiles[0].urdf == profiles[1].urdf


def test_meshes_are_found_beside_the_file_and_stay_where_they_are(tmp_path):
    write_box_mesh(tmp_path / "meshes" / "arm" / "box.stl")
    mesh = '<mesh filename="package://arm/box.stl"/>'
    write(tmp_path, *(e.replace('<sphere radius="0.04"/>', mesh) for e in ARM))
    urdf = profile_of(tmp_path, 'arm.package_paths = ["meshes"]').urdf
    assert str(tmp_path / "meshes" / "arm" / "box.stl") in urdf


@pytest.mark.parametrize(
    ("more", "field", "value"),
    [
        ('arm.tcp = "l3"', "tcp_link", "l3"),
        ('arm.base = "l1"', "arm_joints", ("j2", "j3")),
        ('arm.joints = ["j2", "j3"]', "arm_joints", ("j2", "j3")),
        ('arm.gripper = "none"', "gripper", None),
    ],
)
def test_what_is_given_is_not_guessed(tmp_path, more, field, value):
    write(tmp_path, *ARM, *FINGERS)
    assert getattr(profile_of(tmp_path, more), field) == value


def test_a_given_home_is_taken(tmp_path):
    write(tmp_path, *ARM)
    home = profile_of(tmp_path, "arm.home = [0.1, 0.7, 0.9]").home_rad
    assert home is not None
    assert home.tolist() == [0.1, 0.7, 0.9]


def test_cameras_have_their_roles(tmp_path):
    write(tmp_path, *ARM)
    config = config_of(tmp_path, 'arm.cameras = ["side", "wrist"]')
    cameras = registry_of(config).get(RobotSpec, "mine").cameras
    assert [(one.name, one.role) for one in cameras] == [("side", "primary"), ("wrist", "wrist")]


FOLDED = [0.0, 2.0, 2.0]
"""The tip of `ARM` with larger links meets its base."""


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ('arm.tcp = "hand"', ("hand",)),
        ('arm.joints = ["j9"]', ("j9",)),
        ('arm.gripper = "j9"', ("j9",)),
        ("arm.home = [0.0]", ("home", "j1")),
        ("arm.home = [0.0, 0.0, 9.0]", ("limits", "j3")),
        (f"arm.home = {FOLDED}", ("home", "touch")),
    ],
)
def test_what_does_not_fit_is_refused_with_its_name(tmp_path, more, words):
    write(tmp_path, *(e.replace('radius="0.04"', 'radius="0.14"') for e in ARM))
    told = refusal(tmp_path, more)
    assert all(word in told for word in words), told


def test_a_missing_file_is_named(tmp_path):
    assert str(tmp_path / "sample.urdf") in refusal(tmp_path, "")


@pytest.mark.parametrize(
    ("old", "new", "word"),
    [
        ('name = "mine"', 'name = "fr3"', "fr3"),
        ('"sample.urdf"', '"sample.urdf"\ndisabled_plugins = []', "disabled_plugins"),
        ("arm.urdf", "arm.urd", "urdf"),
    ],
)
def test_names_and_keys_that_do_not_fit_are_refused(tmp_path, old, new, word):
    write(tmp_path, *ARM)
    text = LINES.format(driver="simulated", more="").replace(old, new)
    (tmp_path / "roboneuron.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        registry_of(load_config(tmp_path / "roboneuron.toml"))
    assert word in str(caught.value)


def test_a_client_may_choose_another_robot_and_this_one_again(tmp_path):
    write(tmp_path, *ARM)
    config = config_of(tmp_path)
    registry = registry_of(config)
    for name, is_declared in (("fr3", False), ("mine", True)):
        robot = choose("robot", config, registry, StartRobot(robot=name), "").config.robot
        assert (robot.name, robot.arm is not None) == (name, is_declared)
        there = discover(config.disabled_plugins, robot)  # as in the module's process
        assert load_profile(there, robot).name == name


def test_without_the_plugin_the_error_names_it(tmp_path):
    write(tmp_path, *ARM)
    config = config_of(tmp_path)
    with pytest.raises(ConfigurationError) as caught:
        discover(("rn-declared-arm",), config.robot)
    assert "rn-declared-arm" in f"{caught.value}{caught.value.hint}"


def test_two_arms_of_one_file_have_their_own(tmp_path):
    for side, elements in (("left", ARM), ("right", (*ARM, *FINGERS))):
        write(tmp_path / side, *elements)
    rows = [
        f'[robots.{side}.robot]\nname = "{side}-arm"\narm.urdf = "{side}/sample.urdf"\n'
        for side in ("left", "right")
    ]
    (tmp_path / "roboneuron.toml").write_text("\n".join(rows), encoding="utf-8")
    config = load_config(tmp_path / "roboneuron.toml")
    grippers = {
        name: load_profile(registry_of(one), f"{name}-arm").gripper
        for name, one in config.robots.items()
    }
    assert grippers["left"] is None
    assert grippers["right"] is not None


def test_the_command_says_what_was_guessed(tmp_path, capsys):
    write(tmp_path, *ARM, *FINGERS)
    config_of(tmp_path)
    assert main(["config", "arm", str(tmp_path / "roboneuron.toml")]) == 0
    told = capsys.readouterr().out
    assert all(word in told for word in ("base_link", "tcp", "slide", "acceleration", "Home"))
    (tmp_path / "roboneuron.toml").write_text('[robot]\nname = "fr3"\n', encoding="utf-8")
    assert main(["config", "arm", str(tmp_path / "roboneuron.toml")]) == 2


def test_the_home_of_the_command_can_be_written_down(tmp_path, capsys):
    write(tmp_path, *ARM)
    found = profile_of(tmp_path).home_rad
    assert main(["config", "arm", str(tmp_path / "roboneuron.toml")]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    written = profile_of(tmp_path, f"arm.home = {line[line.index('[') :]}").home_rad
    assert found is not None
    assert np.allclose(found, written, atol=1e-6)
