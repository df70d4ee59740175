"""A sourced ROS and the wheels: which one is used and why, without remains of the other."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from roboneuron.errors import ConfigurationError
from roboneuron.ros import installation
from roboneuron.ros.environment import set_defaults
from roboneuron.ros.installation import (
    BOOTSTRAP_GUARD,
    CHOICE,
    Choice,
    Installation,
    arranged,
    choose,
    chosen,
    find_sourced,
    in_use,
)

VENV = "/venv"
PYTHON = (3, 12)


def lay_out(folder: Path, python: str = "3.12", packages: str = "site-packages") -> Path:
    """A folder laid out like an installation of ROS, with only marker files."""
    package = folder / "lib" / f"python{python}" / packages / "rclpy"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (folder / "lib" / "librcl.so").touch()
    return folder


def source(ros: Path, *workspaces: Path, **given: str) -> dict[str, str]:
    """The environment of a shell with an installation and workspaces sourced in this order."""
    found = {"PATH": "/usr/bin", **given}
    for prefix in (ros, *workspaces):
        for name, folder in (
            ("AMENT_PREFIX_PATH", prefix),
            ("LD_LIBRARY_PATH", prefix / "lib"),
            ("PYTHONPATH", prefix / "lib/python3.12/site-packages"),
        ):
            found[name] = os.pathsep.join([str(folder), *filter(None, [found.get(name)])])
    return {**found, "ROS_DISTRO": "kilted"}


@pytest.fixture
def ros(tmp_path: Path) -> Path:
    """An installation for Python 3.12."""
    return lay_out(tmp_path / "ros")


@pytest.mark.parametrize("packages", ["site-packages", "dist-packages"])
def test_the_installation_below_workspaces_is_found(tmp_path: Path, packages: str) -> None:
    ros = lay_out(tmp_path / "kilted", packages=packages)
    workspace = tmp_path / "workspace"
    found = find_sourced(source(ros, workspace), VENV)
    assert found is not None
    assert (found.prefix, found.distribution, found.python) == (ros, "kilted", (3, 12))
    assert found.prefixes == (workspace, ros)


def test_an_overlay_of_the_wheels_is_no_sourced_installation(tmp_path: Path) -> None:
    venv = lay_out(tmp_path / "venv")
    assert find_sourced(source(tmp_path / "overlay", venv), str(venv)) is None
    assert find_sourced({}, VENV) is None


@pytest.mark.parametrize(
    ("wanted", "python", "kind", "why"),
    [
        ("auto", (3, 12), "sourced", "is sourced, for this Python 3.12"),
        ("auto", (3, 11), "wheels", "is for Python 3.12, and this is Python 3.11"),
        ("wheels", (3, 12), "wheels", 'installation = "wheels"'),
        ("sourced", (3, 12), "sourced", "is sourced"),
    ],
)
def test_a_choice_says_why(
    ros: Path, wanted: Installation, python: tuple[int, int], kind: str, why: str
) -> None:
    choice = choose(wanted, find_sourced(source(ros), VENV), python)
    assert choice.installation == kind
    assert why in choice.reason


def test_what_cannot_be_sourced_is_refused_with_the_way_out(tmp_path: Path, ros: Path) -> None:
    with pytest.raises(ConfigurationError, match="no ROS installation is sourced") as refused:
        choose("sourced", None, PYTHON)
    assert "setup.bash" in str(refused.value.hint)
    with pytest.raises(ConfigurationError, match=r"3\.12, and this is Python 3\.13") as refused:
        choose("sourced", find_sourced(source(ros), VENV), (3, 13))
    assert "Install RoboNeuron with python3.12" in str(refused.value.hint)
    old = find_sourced(source(lay_out(tmp_path / "humble", "3.11")), VENV)
    with pytest.raises(ConfigurationError, match=r"3\.11") as refused:
        choose("sourced", old, (3, 11))
    assert "Python 3.12 or newer" in str(refused.value.hint)
    assert choose("auto", old, (3, 11)).installation == "wheels"
    assert choose("auto", None, PYTHON).installation == "wheels"


def test_wheels_are_left_alone_with_what_is_the_users(tmp_path: Path, ros: Path) -> None:
    environment = source(
        ros,
        tmp_path / "workspace",
        LD_LIBRARY_PATH="/mine:/venv/lib",
        PYTHONPATH="/my/modules",
    )
    sourced = find_sourced(environment, VENV)
    assert sourced is not None
    found = arranged(environment, VENV, sourced, Choice("wheels", "so"))
    assert found == {
        "PATH": "/usr/bin",
        "LD_LIBRARY_PATH": "/mine:/venv/lib",
        "PYTHONPATH": "/my/modules",
        CHOICE: "wheels: so",
    }
    assert chosen(found) == Choice("wheels", "so")
    set_defaults(found, prefix=VENV, log_directory=tmp_path)
    assert found["AMENT_PREFIX_PATH"] == VENV


@pytest.mark.parametrize("library", ["libfastrtps.so.2.14", "libfastdds.so.3.2"])
def test_a_sourced_installation_is_left_alone(tmp_path: Path, ros: Path, library: str) -> None:
    (ros / "lib" / library).touch()
    environment = source(ros, LD_LIBRARY_PATH="/venv/lib:/venv/ros_rcl.libs:/mine")
    sourced = find_sourced(environment, VENV)
    assert sourced is not None
    found = arranged(environment, VENV, sourced, Choice("sourced", "so"))
    assert found["LD_LIBRARY_PATH"] == f"{ros}/lib:/mine"
    assert found[BOOTSTRAP_GUARD] == "1"
    assert found["PYTHONPATH"] == environment["PYTHONPATH"]
    assert arranged(found, VENV, sourced, chosen(found)) == found
    set_defaults(found, prefix=VENV, log_directory=tmp_path)
    assert found["AMENT_PREFIX_PATH"] == str(ros)
    name = library.partition(".")[0].removeprefix("lib").upper()
    assert f"{name}_DEFAULT_PROFILES_FILE" in found


def test_a_mixture_is_refused(tmp_path: Path, ros: Path) -> None:
    environment = source(ros, LD_LIBRARY_PATH="/venv/lib")
    with pytest.raises(ConfigurationError, match=r"ROS kilted of .* would be mixed") as refused:
        set_defaults(environment, prefix=VENV, log_directory=tmp_path)
    assert "by the command `roboneuron`" in str(refused.value.hint)
    environment[CHOICE] = "sourced: before"
    with pytest.raises(ConfigurationError, match="would be mixed"):
        set_defaults(environment, prefix=VENV, log_directory=tmp_path)


def test_wheels_of_another_environment_are_no_sourced_installation(
    tmp_path: Path, ros: Path
) -> None:
    """Variables that a process of that environment passes to its children."""
    (ros / "pyvenv.cfg").touch()
    environment = source(ros)
    assert find_sourced(environment, VENV) is None
    with pytest.raises(ConfigurationError, match="has started this one") as refused:
        set_defaults(environment, prefix=VENV, log_directory=tmp_path)
    assert "without AMENT_PREFIX_PATH" in str(refused.value.hint)


def test_a_command_starts_again_without_the_wheels_of_another_environment(tmp_path: Path) -> None:
    other = lay_out(tmp_path / "other", ".".join(map(str, sys.version_info[:2])))
    (other / "pyvenv.cfg").touch()
    environment = {**os.environ, **source(other), BOOTSTRAP_GUARD: "1"}
    program = (
        "import os; from roboneuron.ros.installation import keep_apart; keep_apart([]); "
        "names = ['AMENT_PREFIX_PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH', 'ROBONEURON_ROS']; "
        "print(*(os.environ.get(name) for name in names))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert str(other) not in ended.stdout
    assert "sourced" not in ended.stdout


def test_the_installation_in_use_has_its_folders(ros: Path) -> None:
    assert in_use({}, VENV, "auto").roots == (Path(VENV),)
    assert in_use({"AMENT_PREFIX_PATH": str(ros)}, VENV, "auto").roots == (ros,)
    with pytest.raises(ConfigurationError, match="no ROS installation is sourced"):
        in_use({}, VENV, "sourced")


@pytest.mark.parametrize("form", ["--config={}", "--config {}"])
@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('[ros]\ninstallation = "wheels"', "wheels"),
        ('[ros]\ninstallation = "sourced"', "sourced"),
        ('[ros]\ninstallation = "both"', "auto"),
        ("ros = 1", "auto"),
        ("no TOML", "auto"),
        ("", "auto"),
    ],
)
def test_the_configuration_on_the_command_line_is_asked(
    tmp_path: Path, form: str, text: str, wanted: str
) -> None:
    path = tmp_path / "roboneuron.toml"
    path.write_text(text)
    assert installation._wanted(["--port", "1", *form.format(path).split()]) == wanted
    assert installation._wanted(["--config", str(tmp_path / "nowhere")]) == "auto"
    assert installation._wanted([]) == "auto"


def test_a_command_starts_again_without_what_it_does_not_use(tmp_path: Path) -> None:
    other = "3.10" if sys.version_info[:2] == (3, 11) else "3.11"
    ros = lay_out(tmp_path / "ros", other)
    environment = {**os.environ, **source(ros)}
    environment["LD_LIBRARY_PATH"] += f":{os.environ.get('LD_LIBRARY_PATH', '')}"
    program = "import os, sys; from roboneuron.ros.installation import keep_apart; keep_apart([]); "
    shown = "print(sys.argv[1:], *(os.environ.get(n) for n in sys.argv[1:]), sep=chr(10))"
    names = ["AMENT_PREFIX_PATH", "PYTHONPATH", "LD_LIBRARY_PATH", CHOICE]
    ended = subprocess.run(
        [sys.executable, "-c", program + shown, *names],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    words, prefixes, modules, libraries, why = ended.stdout.splitlines()
    assert words == str(names)
    assert (prefixes, modules) == ("None", "None")
    assert str(ros) not in libraries
    assert why.startswith(f"wheels: ROS kilted of {ros} is for Python {other}")
