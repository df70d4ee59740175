"""Sources of the files when loading a checkpoint, and folders that are no policy."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot_cell import NAMES, Load, observe
from safetensors.numpy import load_file, save_file

from rn_backend_lerobot.isolation import offline
from roboneuron import CheckpointError, ConfigurationError

BENCH = Path(__file__).parents[4] / "benchmarks" / "bench_lerobot.py"


@pytest.fixture
def copied(checkpoints: dict[str, Path], tmp_path: Path) -> Callable[..., Path]:
    """Return a function that copies a checkpoint and changes its config.json."""

    def make(policy: str, **changes: Any) -> Path:
        folder = tmp_path / policy
        shutil.copytree(checkpoints[policy], folder)
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, **changes}))
        return folder

    return make


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Addresses to which a connection was attempted; none is reached."""
    wanted: list[object] = []

    def connect(self: socket.socket, address: object) -> None:
        wanted.append(address)
        raise OSError("there is no network here")

    monkeypatch.setattr(socket.socket, "connect", connect)
    return wanted


def test_a_backbone_of_the_hub_is_taken_from_the_folder_that_the_user_names(
    copied: Callable[..., Path], checkpoints: dict[str, Path], load: Load, no_network: list[object]
) -> None:
    name = "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"
    folder = copied("smolvla", vlm_model_name=name)
    text = (folder / "policy_preprocessor.json").read_text()
    here = str(checkpoints["smolvla"] / "backbone")
    (folder / "policy_preprocessor.json").write_text(text.replace(here, name))
    backend = load("smolvla", checkpoint=folder, folders={name: here})
    plain = load("smolvla")
    backend.reset()
    plain.reset()
    expected = plain.predict(observe(0)).actions
    np.testing.assert_array_equal(backend.predict(observe(0)).actions, expected)
    assert no_network == []


def test_image_weights_that_the_checkpoint_replaces_are_not_fetched(
    copied: Callable[..., Path], load: Load, no_network: list[object]
) -> None:
    """LeRobot's default fetches these weights, and then loads the checkpoint's."""
    folder = copied("act", pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    backend = load("act", checkpoint=folder)
    expected = load("act").predict(observe(0)).actions
    np.testing.assert_array_equal(backend.predict(observe(0)).actions, expected)
    assert no_network == []


def test_the_hub_is_not_asked_while_lerobot_loads(monkeypatch: pytest.MonkeyPatch) -> None:
    import huggingface_hub.constants

    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", False)
    with offline():
        assert os.environ["HF_HUB_OFFLINE"] == "1"
        assert huggingface_hub.constants.HF_HUB_OFFLINE
    assert "HF_HUB_OFFLINE" not in os.environ


@pytest.mark.parametrize("policy", ["act", "pi05"])
def test_weights_that_do_not_fit_are_refused(
    copied: Callable[..., Path], load: Load, policy: str
) -> None:
    """LeRobot's pi05 only prints the error, and continues with random weights."""
    folder = copied(policy)
    weights = load_file(folder / "model.safetensors")
    name = next(key for key in sorted(weights) if weights[key].ndim == 2)
    weights[name] = weights[name][:, :-1].copy()
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(CheckpointError) as refusal:
        load(policy, checkpoint=folder)
    assert name.rpartition(".")[0].split(".")[-1] in refusal.value.message


@pytest.mark.parametrize("policy", ["act", "smolvla", "pi05"])
def test_missing_weights_are_refused_and_surplus_ones_do_no_harm(
    copied: Callable[..., Path], load: Load, policy: str
) -> None:
    """LeRobot logs both, and continues."""
    folder = copied(policy)
    weights = load_file(folder / "model.safetensors")
    save_file({**weights, "normalize_inputs.mean": np.zeros(3)}, folder / "model.safetensors")
    load(policy, checkpoint=folder)
    name = next(key for key in sorted(weights) if weights[key].ndim == 2)
    del weights[name]
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(CheckpointError, match=rf"there is no {re.escape(name)}"):
        load(policy, checkpoint=folder)


def test_a_policy_that_lerobot_does_not_know_is_named(
    copied: Callable[..., Path], load: Load
) -> None:
    folder = copied("act", type="telepathy")
    with pytest.raises(CheckpointError, match="a policy 'telepathy', which LeRobot") as refusal:
        load("act", checkpoint=folder)
    assert "lerobot_policy_" in refusal.value.hint


def test_a_gpu_that_is_not_there_is_named(load: Load) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    with pytest.raises(ConfigurationError, match="'device' is 'cuda', and PyTorch finds no GPU"):
        load("act", device="cuda")


def test_a_third_partys_policy_is_found_by_the_name_of_its_package(
    load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The policy of the benchmark: its rows are the measured state."""
    site = tmp_path / "site"
    runpy.run_path(str(BENCH))["install"](site)
    # in another process, where nothing has imported it yet
    code = (
        "import runpy, sys; from pathlib import Path; "
        "make = runpy.run_path(sys.argv[1])['make_checkpoint']; "
        "make(Path(sys.argv[2]), ('front', 'wrist'), 96, 96)"
    )
    subprocess.run(
        [sys.executable, "-c", code, str(BENCH), str(tmp_path / "null")],
        env={**os.environ, "PYTHONPATH": str(site)},
        check=True,
        timeout=120,
    )
    monkeypatch.syspath_prepend(str(site))
    assert "lerobot_policy_null" not in sys.modules
    chunk = load("null", checkpoint=tmp_path / "null").predict(observe(3))
    joints = observe(3).joints
    assert joints is not None
    assert chunk.actions.shape == (16, len(NAMES))
    np.testing.assert_allclose(chunk.actions[:, :7], np.tile(joints.position, (16, 1)), atol=1e-6)
