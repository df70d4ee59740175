"""lerobot's calibration files: an error is named precisely."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from rn_robot_lerobot.bus.reference import ASSEMBLED_SO101
from rn_robot_lerobot.calibration import read_calibration
from rn_robot_lerobot.lerobot_arm import check_version
from roboneuron import ConfigurationError, MissingDependencyError

MOTORS = tuple(ASSEMBLED_SO101.calibration())
COMMAND = "lerobot-calibrate --robot.id=so101"


def facts() -> dict[str, dict[str, object]]:
    return {name: asdict(motor) for name, motor in ASSEMBLED_SO101.calibration().items()}


def test_a_whole_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "so101.json"
    path.write_text(json.dumps(facts()))
    assert read_calibration(path, MOTORS, COMMAND) == ASSEMBLED_SO101.calibration()


def damaged(change: str) -> str:
    told = facts()
    if change == "absent motor":
        del told["gripper"]
    elif change == "unknown motor":
        told["tail"] = told["gripper"]
    elif change == "empty range":
        told["gripper"]["range_max"] = told["gripper"]["range_min"]
    elif change == "beyond the encoder":
        told["gripper"]["range_max"] = 5000
    elif change == "no number":
        told["gripper"]["homing_offset"] = "12"
    elif change == "no field":
        del told["gripper"]["drive_mode"]
    elif change == "no motors":
        return "[]"
    elif change == "no json":
        return "{"
    return json.dumps(told)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("absent motor", "lacks 'gripper'"),
        ("unknown motor", "names the unknown motor 'tail'"),
        ("empty range", "The range of motor 'gripper'"),
        ("beyond the encoder", "The range of motor 'gripper'"),
        ("no number", "expected whole numbers"),
        ("no field", "does not have id, drive_mode"),
        ("no motors", "holds no motors"),
        ("no json", "cannot be read"),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path: Path, change: str, words: str) -> None:
    path = tmp_path / "so101.json"
    path.write_text(damaged(change))
    with pytest.raises(ConfigurationError, match=words):
        read_calibration(path, MOTORS, COMMAND)


def test_a_lacking_file_is_refused_with_the_command_that_makes_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="There is no calibration") as refused:
        read_calibration(tmp_path / "so101.json", MOTORS, COMMAND)
    assert COMMAND in refused.value.hint


@pytest.mark.parametrize("version", ["0.6.1", "0.6.2", "0.6.10+cpu"])
def test_versions_that_the_driver_was_written_for_are_taken(version: str) -> None:
    check_version(version)


@pytest.mark.parametrize("version", ["0.5.1", "0.6.0", "0.7.0", "1.0"])
def test_other_versions_of_lerobot_are_refused_by_number(version: str) -> None:
    with pytest.raises(ConfigurationError, match=f"lerobot is {version}"):
        check_version(version)


def test_an_environment_without_lerobot_is_refused_with_what_to_do() -> None:
    with pytest.raises(MissingDependencyError, match="this one has none") as refused:
        check_version(None)
    assert "python = ..." in refused.value.hint
