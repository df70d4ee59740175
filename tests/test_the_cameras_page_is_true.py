"""What docs/cameras.md types is taken: its commands by the parsers, its configuration by core and
the source, its limits by the calibration.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rn_cameras")

from rn_cameras import calibrating
from rn_cameras.command import Cameras
from rn_perception_camera.options import RosCamerasOptions, VideoCamerasOptions
from rn_standard.console.parsers import whole_parser
from roboneuron.config import parse_config

OPTIONS = {"ros-camera": RosCamerasOptions, "video-camera": VideoCamerasOptions}


@pytest.fixture
def page(root: Path) -> str:
    return (root / "docs" / "cameras.md").read_text(encoding="utf-8")


def commands(page: str) -> list[list[str]]:
    return [line.split()[1:] for line in re.findall(r"^ *(roboneuron .*)$", page, re.MULTILINE)]


def test_its_commands_are_taken_by_the_parsers(page: str) -> None:
    actions = {whole_parser().parse_args(words).action for words in commands(page)}
    assert actions == {"list", "board", "calibrate"}


def test_its_board_is_printed(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    words = next(words for words in commands(page) if "board" in words)
    assert Cameras().run(whole_parser().parse_args(words)) == 0
    assert Path("board.pdf").stat().st_size > 1000


def test_its_configurations_are_accepted(page: str) -> None:
    sources = set()
    for text in re.findall(r"```toml\n(.*?)```", page, re.DOTALL):
        perception = parse_config(text).perception
        assert perception is not None
        options = json.dumps(tomllib.loads(text)["plugins"][perception.source])
        told = OPTIONS[perception.source].model_validate_json(options)
        assert tuple(told.cameras) == perception.cameras
        sources.add(perception.source)
    assert sources == OPTIONS.keys()


def test_its_setups_and_limits_are_those_of_the_command(page: str) -> None:
    calibrate = ["robot", "cameras", "calibrate", "front", "--setup"]
    setups = re.findall(
        r"^ *\| `([a-z][a-z-]+)` \|", page.partition("written into")[0], re.MULTILINE
    )
    assert {whole_parser().parse_args([*calibrate, one]).setup for one in setups} == {
        "eye-in-hand",
        "eye-to-hand",
        "corners",
    }
    px, mm, degrees = re.findall(r"Above (\d+) px, (\d+) mm or (\d+) degree", page)[0]
    assert float(px) == calibrating.MOST_ERROR_PX
    assert float(mm) == calibrating.MOST_DEVIATION_M * 1000
    assert float(degrees) == pytest.approx(np.degrees(calibrating.MOST_DEVIATION_RAD))
