"""Libraries of more than one ROS in one process, and what brings them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pytest

from rn_standard.doctor import installations
from rn_standard.doctor.finding import Severity

ROOT = Path("/opt/ros/kilted")


def libraries(*paths: str) -> list[Path]:
    """Files, of which those with a relative path are of the root."""
    return [ROOT / path for path in paths]


def test_one_installation_is_well() -> None:
    found = libraries(
        "lib/libfastdds.so.3.2", "lib/librcl.so", "/ws/lib/librmw_fastrtps_cpp.so", "/lib/libc.so.6"
    )
    assert installations.mixed(found, [ROOT, Path("/ws")]) == ""


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        (
            ("lib/libfastdds.so.3.2", "/venv/lib/libfastrtps.so.2.14"),
            "more than one Fast DDS: /opt/ros/kilted/lib/libfastdds.so.3.2 and /venv/lib/",
        ),
        (
            ("lib/libfastdds.so.3.2", "/other/lib/libfastdds.so.3.2"),
            "more than one Fast DDS",
        ),
        (
            ("lib/libfastdds.so.3.2", "/venv/lib/librcl.so"),
            "from outside /opt/ros/kilted: /venv/lib/librcl.so",
        ),
        (("/usr/lib/libfastcdr.so.1",), "from outside /opt/ros/kilted: /usr/lib/libfastcdr.so.1"),
    ],
)
def test_libraries_of_two_are_named(paths: tuple[str, ...], words: str) -> None:
    assert words in installations.mixed(libraries(*paths), [ROOT])


class Used(NamedTuple):
    """What is used by an environment with a variable too many."""

    choice: tuple[str, str] = ("wheels", "so")
    roots: tuple[Path, ...] = (ROOT,)


@pytest.fixture
def other(tmp_path: Path) -> Path:
    """The folder of another ROS."""
    package = tmp_path / "modules/rclpy/__init__.py"
    library = tmp_path / "lib/librcl.so"
    for file in (package, library):
        file.parent.mkdir(parents=True)
        file.touch()
    return tmp_path


def test_what_brings_another_ros_is_named_with_what_to_type(
    other: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LD_LIBRARY_PATH", f"{other}/lib")
    monkeypatch.setenv("PYTHONPATH", "")
    finding = installations.look(Used())
    assert finding.verdict is Severity.FAILED
    assert f"mixed with that of {ROOT}: {other}/lib by LD_LIBRARY_PATH" in finding.text
    assert finding.hint == "Type: unset LD_LIBRARY_PATH"


def test_folders_of_another_ros_are_named(other: Path) -> None:
    folders = {"LD_LIBRARY_PATH": f"{other}/lib:/mine", "PYTHONPATH": f"/my:{other}/modules"}
    found = installations.foreign_folders(folders, [ROOT])
    assert found == (("LD_LIBRARY_PATH", f"{other}/lib"), ("PYTHONPATH", f"{other}/modules"))
    assert installations.foreign_folders(folders, [ROOT, other]) == ()
