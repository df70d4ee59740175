"""The whole system, as in `make demo`: MCP client -> server -> four ROS processes -> simulator."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

pytestmark = [pytest.mark.ros, pytest.mark.timeout(300)]


def demo(
    environment: dict[str, str], output: Path, *arguments: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "roboneuron.cli.main", "demo", "--out", str(output), *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


def test_the_simulator_sees_the_named_cube_lifted_and_held(
    environment: dict[str, str], tmp_path: Path
) -> None:
    result = demo(
        environment, tmp_path, "--seed", "3", "--instruction", "please grab the blue block"
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "blue lifted by" in result.stdout
    for name, frames in (("film-strip.png", 1), ("film.gif", 5)):
        with Image.open(tmp_path / name) as image:
            assert getattr(image, "n_frames", 1) >= frames
    assert (tmp_path / "server.log").exists()


@pytest.mark.slow  # test_commands_end_in_one_line.py runs the same command in less time
def test_an_instruction_that_names_nothing_fails_and_says_so(
    environment: dict[str, str], tmp_path: Path
) -> None:
    result = demo(environment, tmp_path, "--seed", "3", "--instruction", "make me a coffee")
    assert result.returncode != 0
    assert "names 0 objects" in result.stdout + result.stderr
