"""docs/tutorials/openvla-oft.md: its commands make checkpoints that its file loads, each model
moves the simulated arm, and the lines for a GPU and for a real arm are valid.
"""

from __future__ import annotations

import json
import re
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rn_robot_fr3.profile import profile
from rn_runtime_torch.config import TorchRuntimeConfig
from roboneuron.cli.main import main

PAGE = (Path(__file__).parents[1] / "docs" / "tutorials" / "openvla-oft.md").read_text(
    encoding="utf-8"
)
FILES = dict(re.findall(r"<!-- file: (\S+) -->\n```\w+\n(.*?)```", PAGE, flags=re.DOTALL))
BLOCKS = re.findall(r"```bash\n(.*?)```", PAGE, flags=re.DOTALL)
[MAKE_TINY] = [block for block in BLOCKS if "make-tiny" in block]
[MOVE] = [block for block in BLOCKS if "config check" in block]


def of_a_real_arm() -> str:
    """The configuration of the page's end: lines for the arm in place of the first three tables."""
    whole = FILES["roboneuron.toml"]
    return FILES["real.toml"] + whole[whole.index("[control]") :]


def typed(
    block: str, folder: Path, environment: dict[str, str]
) -> subprocess.CompletedProcess[str]:
    """A block of the page, as its reader types it."""
    return subprocess.run(
        ["bash", "-ec", block],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.fixture
def folder(tmp_path: Path, environment: dict[str, str]) -> Path:
    """A folder with the checkpoints and the file of the page."""
    made = typed(MAKE_TINY, tmp_path, environment)
    assert made.returncode == 0, made.stdout + made.stderr
    (tmp_path / "roboneuron.toml").write_text(FILES["roboneuron.toml"], encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize("kind", ["simulated", "on a GPU", "real"])
def test_the_files_of_the_page_are_valid(
    folder: Path, capsys: pytest.CaptureFixture[str], kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    text = FILES["roboneuron.toml"] if kind != "real" else of_a_real_arm()
    if kind == "on a GPU":
        text += FILES["gpu.toml"]
    (folder / "roboneuron.toml").write_text(text, encoding="utf-8")
    assert main(["config", "check", "roboneuron.toml"]) == 0, capsys.readouterr().err


def test_the_lines_for_a_gpu_demand_one() -> None:
    torch = tomllib.loads(FILES["gpu.toml"])["plugins"]["torch"]
    assert TorchRuntimeConfig(**torch).device == "cuda"


def test_a_checkpoint_has_the_files_that_the_page_names(folder: Path) -> None:
    words = PAGE.partition("- OFT's folder has")[2].partition("\n- ")[0]
    named = re.findall(r"`([^`]+)`", words)
    assert len(named) == 7
    for name in named:
        pattern = name.replace("--N", "--*").replace("model.", "model*.")  # one file, or shards
        assert list((folder / "oft").glob(pattern)), name


@pytest.mark.exhaustive
@pytest.mark.ros
@pytest.mark.timeout(600)
def test_each_model_of_the_page_moves_the_simulated_arm(
    folder: Path, environment: dict[str, str]
) -> None:
    done = typed(MOVE, folder, {**environment, "OMP_NUM_THREADS": "1"})
    told = f"{done.stdout}{done.stderr}"
    models = re.findall(r"^for model in (.*); do$", MOVE, flags=re.MULTILINE)[0].split()
    outcomes = outcomes_of(done.stdout)
    assert len(outcomes) == len(models), told
    home = dict(zip(profile().arm_joints, profile().home_rad, strict=True))
    for outcome in outcomes:
        joints = outcome["state"]["joints"]
        moved_rad = [joints[name] - home[name] for name in home]
        assert np.abs(moved_rad).max() > 0.02, told


def outcomes_of(printed: str) -> list[dict[str, Any]]:
    """The answers of run_task among the JSON that `roboneuron call` prints."""
    decoder, found, at = json.JSONDecoder(), [], printed.find("{")
    while at >= 0:
        answer, end = decoder.raw_decode(printed, at)
        if "outcome" in answer:
            found.append(answer)
        at = printed.find("{", end)
    return found
