"""pi0-FAST: tokens and chunks compared with LeRobot's own code on the same tiny checkpoint, and
refusals.

parity/lerobot_fast_numbers.py computed the numbers; `make test-parity` computes them again and
compares.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rn_backend_pi0.fast import Pi0FastBackend
from rn_backend_pi0.fast_model import FastModel
from rn_backend_pi0.fast_network import FastNetwork
from rn_backend_pi0.fast_tokens import FastTokenizer, load_fast_tokenizer
from rn_backend_pi0.image import to_pixels
from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0FastOptions, Pi0Options
from rn_backend_pi0.prompt import InstructionEncoder, load_prompt
from rn_backend_pi0.tiny import make_tiny
from rn_backend_pi0.weights import load_network
from roboneuron import CheckpointError, JointSample, Observation, UngroundedError

NUMBERS = Path(
    os.environ.get("PI0_FAST_NUMBERS", Path(__file__).parent / "data" / "pi0-fast-lerobot.npz")
)
CASES = {"main": (0, 1), "one_camera": (0,), "other_prompt": (0, 1)}
STEPS = 24
ARM = tuple(f"j{i}" for i in range(7))
Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def arrays() -> Arrays:
    """All arrays of the file."""
    with np.load(NUMBERS) as file:
        return dict(file)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint on which LeRobot's code was run. Read-only."""
    directory = tmp_path_factory.mktemp("fast") / "tiny"
    make_tiny(directory, variant="pi0_fast", profile="droid")
    return directory


@pytest.fixture(scope="module")
def network(checkpoint: Path, arrays: Arrays) -> FastNetwork:
    """The network of the checkpoint, loaded."""
    dims = read_checkpoint(checkpoint).dims
    network = load_network(checkpoint, dims, device=torch.device("cpu"), dtype=torch.float32)
    assert isinstance(network, FastNetwork)
    weight = network.vision.get_parameter("layers.0.mlp.fc1.weight")[0].numpy()
    # If these differ, this PyTorch draws other weights from the same seed.
    np.testing.assert_array_equal(weight, arrays["weight"])
    return network


@pytest.fixture(scope="module")
def prompt(checkpoint: Path) -> InstructionEncoder:
    """The checkpoint's encoder of instructions and states."""
    return load_prompt(
        checkpoint, None, family="lerobot", max_tokens=200, vocabulary=640, variant="pi0_fast"
    )


def _tokenizer(checkpoint: Path, length: Any = "exact", **shape: int) -> FastTokenizer:
    size = {"horizon": 10, "width": 8, **shape}
    return load_fast_tokenizer(checkpoint, None, length=length, **size)


@pytest.mark.parametrize("case", CASES)
def test_the_tokens_are_those_of_lerobot(
    network: FastNetwork, prompt: InstructionEncoder, arrays: Arrays, case: str
) -> None:
    """LeRobot chooses among all tokens and starts without given ones, so this test does the
    same.
    """
    pictures = arrays["cells"].repeat(16, axis=1).repeat(16, axis=2)
    pixels = [to_pixels(pictures[i], side=224, resize="plain", flip="none") for i in CASES[case]]
    written, outside = network.write_tokens(
        torch.from_numpy(np.stack(pixels)),
        torch.from_numpy(arrays[f"{case}/prompt"]),
        given=(),
        allowed=torch.arange(640),
        stop=prompt.token_ids("|")[0],
        most=STEPS,
    )
    assert written == arrays[f"{case}/tokens"].tolist()
    assert outside == 0
    assert len(set(written)) > 5  # a model that repeats one token would prove little


def test_each_input_changes_the_tokens(arrays: Arrays) -> None:
    main = arrays["main/tokens"].tolist()
    assert all(arrays[f"{case}/tokens"].tolist() != main for case in CASES if case != "main")


def test_the_prompt_is_that_of_lerobot(prompt: InstructionEncoder, arrays: Arrays) -> None:
    centres = (np.array([3, 120, 255, -1, 99]) + 0.5) / 128 - 1.0
    ids = prompt.encode(" put the red_cube on\nthe plate", centres)
    assert ids == arrays["main/prompt"].tolist()


@pytest.mark.parametrize("name", ["whole", "short"])
def test_tokens_become_the_chunk_that_lerobot_makes_of_them(
    checkpoint: Path, prompt: InstructionEncoder, arrays: Arrays, name: str
) -> None:
    last = prompt.last_id - 4  # fast_skip_tokens of tiny checkpoints
    codes = [last - int(token) for token in arrays[f"{name}/ids"]]
    actions = _tokenizer(checkpoint, "padded").to_actions(codes)
    # LeRobot rounds the chunk to float32.
    np.testing.assert_allclose(actions, arrays[f"{name}/actions"], atol=1e-6, rtol=0)
    if name == "whole":
        # Coefficients are rounded to tenths: an error of at most 0.05 each, ten of them in a
        # column.
        np.testing.assert_allclose(actions, arrays["whole/chunk"], atol=0.16, rtol=0)
        np.testing.assert_array_equal(_tokenizer(checkpoint).to_actions(codes), actions)
    else:
        with pytest.raises(UngroundedError, match="coefficients, a chunk has 10 x 8"):
            _tokenizer(checkpoint).to_actions(codes)


def test_a_tokenizer_for_other_chunks_or_none_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="for chunks of 10 x 8, the model has 10 x 7"):
        _tokenizer(checkpoint, width=7)
    with pytest.raises(CheckpointError, match="no action tokenizer") as refusal:
        _tokenizer(tmp_path)
    assert "physical-intelligence/fast" in refusal.value.hint


def test_code_beside_the_tokenizer_is_never_run(checkpoint: Path, tmp_path: Path) -> None:
    copy = tmp_path / "action_tokenizer"
    shutil.copytree(checkpoint / "action_tokenizer", copy)
    (copy / "processing_action_tokenizer.py").write_text("raise SystemExit('was run')\n")
    config = json.loads((copy / "processor_config.json").read_text())
    config["auto_map"] = {"AutoProcessor": "processing_action_tokenizer.UniversalActionProcessor"}
    (copy / "processor_config.json").write_text(json.dumps(config))
    assert _tokenizer(tmp_path).size == _tokenizer(checkpoint).size


def test_half_a_character_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    """Published tokenizers contain parts of UTF-8 characters, which do not always combine."""
    from tokenizers import Tokenizer, decoders, models

    shutil.copytree(checkpoint / "action_tokenizer", tmp_path / "action_tokenizer")
    tokenizer = Tokenizer(models.BPE(vocab={"a": 0, "Ã": 1}, merges=[]))
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.save(str(tmp_path / "action_tokenizer" / "tokenizer.json"))
    with pytest.raises(UngroundedError, match="no complete coefficients"):
        _tokenizer(tmp_path).to_actions([1, 0])


def _observation(observe: Callable[..., Observation], **changes: Any) -> Observation:
    from dataclasses import replace

    joints = JointSample(names=ARM, position=np.linspace(-0.5, 0.5, 7))
    return replace(observe(wrist=40, **changes), joints=joints)


def _backend(checkpoint: Path, **options: Any) -> Pi0FastBackend:
    given = {"joints": ARM, "max_outside_share": 1.0, "fast_length": "padded", **options}
    config = Pi0FastOptions(checkpoint=checkpoint, device="cpu", cpu_threads=1, **given)
    backend = Pi0FastBackend(config)
    backend.load()
    return backend


def test_a_backend_answers_in_the_space_of_its_profile(
    checkpoint: Path, observe: Callable[..., Observation]
) -> None:
    backend = _backend(checkpoint)
    assert isinstance(backend._model, FastModel)
    chunk = backend.predict(_observation(observe))
    assert chunk.actions.shape == (10, 8)
    assert chunk.space.kind == "joint_velocity"
    other = backend.predict(_observation(observe, instruction="open the drawer"))
    assert np.abs(chunk.actions - other.actions).max() > 1e-3
    backend.close()


def test_a_model_that_would_write_something_else_is_refused(
    checkpoint: Path, observe: Callable[..., Observation]
) -> None:
    backend = _backend(checkpoint, max_outside_share=0.15)
    with pytest.raises(UngroundedError, match="likelier than every action token"):
        backend.predict(_observation(observe))
    backend.close()


def test_each_backend_runs_its_own_variants(checkpoint: Path, tiny_checkpoint: Path) -> None:
    with pytest.raises(CheckpointError, match="holds a pi0_fast model") as refusal:
        Pi0Backend(Pi0Options(checkpoint=checkpoint, joints=ARM)).load()
    assert "'pi0-fast' for pi0_fast" in refusal.value.hint
    with pytest.raises(CheckpointError, match="holds a pi0 model"):
        Pi0FastBackend(Pi0FastOptions(checkpoint=tiny_checkpoint)).load()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("temperature", 0.7, "temperature is 0.7"),
        ("output_features", {}, "output_features has no width"),
        ("fast_skip_tokens", 400, "do not fit into a vocabulary"),
    ],
)
def test_what_cannot_be_followed_is_refused(
    checkpoint: Path, tmp_path: Path, key: str, value: object, message: str
) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(checkpoint, copy)
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, key: value}))
    with pytest.raises(CheckpointError, match=message):
        _backend(copy)
