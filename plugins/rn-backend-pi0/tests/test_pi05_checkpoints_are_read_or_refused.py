"""Both layouts of pi0.5: variant, statistics and refusals; and its real-time chunking."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.tiny import make_tiny
from rn_vla.normalisation import Quantiles, ZScore
from roboneuron import Ahead, CheckpointError, Observation

Observe = Callable[..., Observation]
LAYOUTS = ("lerobot", "openpi")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A tiny pi0.5 in each layout. Read-only."""
    root = tmp_path_factory.mktemp("pi05")
    for layout in LAYOUTS:
        make_tiny(root / layout, layout=layout, variant="pi05")  # type: ignore[arg-type]
    return {path.name: path for path in root.iterdir()}


@pytest.fixture
def copies(made: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Copies that a test may change."""
    return {name: Path(shutil.copytree(path, tmp_path / name)) for name, path in made.items()}


def _edit(path: Path, edit: Callable[[Any], Any]) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def _backend(checkpoint: Path, **options: Any) -> Pi0Backend:
    backend = Pi0Backend(Pi0Options(checkpoint=checkpoint, device="cpu", cpu_threads=1, **options))
    backend.load()
    return backend


@pytest.mark.parametrize("layout", LAYOUTS)
def test_both_layouts_are_pi05_with_quantiles(made: dict[str, Path], layout: str) -> None:
    checkpoint = read_checkpoint(made[layout])
    assert (checkpoint.dims.variant, checkpoint.prompt_length) == ("pi05", 200)
    assert isinstance(checkpoint.state, Quantiles)
    assert checkpoint.action.width == 7


def test_both_layouts_give_the_same_actions(made: dict[str, Path], observe: Observe) -> None:
    """With the same eps, because a state at its mean is at the edge of two bins, and eps
    decides.
    """
    backends = [_backend(made[layout], numerics="openpi") for layout in LAYOUTS]
    one, other = (backend.predict(observe()).actions for backend in backends)
    np.testing.assert_array_equal(one, other)


def test_the_variant_of_openpis_layout_comes_from_the_index_of_shards(
    copies: dict[str, Path],
) -> None:
    directory = copies["openpi"]
    keys = load_shard_keys(directory)
    (directory / "model.safetensors").rename(directory / "model-00001-of-00001.safetensors")
    index = {"weight_map": dict.fromkeys(keys, "model-00001-of-00001.safetensors")}
    (directory / "model.safetensors.index.json").write_text(json.dumps(index))
    assert read_checkpoint(directory).dims.variant == "pi05"


def load_shard_keys(directory: Path) -> list[str]:
    """Keys of the only file."""
    with (directory / "model.safetensors").open("rb") as file:
        header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
    return [key for key in header if key != "__metadata__"]


def test_openpis_layout_without_weights_is_refused(copies: dict[str, Path]) -> None:
    (copies["openpi"] / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors does not exist"):
        read_checkpoint(copies["openpi"])


def test_openpis_statistics_without_quantiles_are_refused(copies: dict[str, Path]) -> None:
    _edit(
        copies["openpi"] / "assets/tiny/norm_stats.json",
        lambda content: content["norm_stats"]["state"].pop("q01"),
    )
    with pytest.raises(CheckpointError, match=r"norm_stats\.json.*q01"):
        read_checkpoint(copies["openpi"])


def test_quantiles_in_the_wrong_order_are_refused(copies: dict[str, Path]) -> None:
    def swap(content: Any) -> None:
        block = content["norm_stats"]["actions"]
        block["q01"], block["q99"] = block["q99"], block["q01"]

    _edit(copies["openpi"] / "assets/tiny/norm_stats.json", swap)
    with pytest.raises(CheckpointError, match="q01 is above"):
        read_checkpoint(copies["openpi"])


def test_a_range_of_zero_cannot_be_normalised(copies: dict[str, Path]) -> None:
    def flatten(content: Any) -> None:
        block = content["norm_stats"]["state"]
        block["q99"][3] = block["q01"][3]

    _edit(copies["openpi"] / "assets/tiny/norm_stats.json", flatten)
    with pytest.raises(CheckpointError, match=r"range of the state values 3 \(rotvec\) is 0"):
        _backend(copies["openpi"])


def test_lerobots_layout_may_say_mean_and_deviation(copies: dict[str, Path]) -> None:
    _edit(
        copies["lerobot"] / "config.json",
        lambda config: config["normalization_mapping"].update(STATE="MEAN_STD"),
    )
    checkpoint = read_checkpoint(copies["lerobot"])
    assert isinstance(checkpoint.state, ZScore)
    assert isinstance(checkpoint.action, Quantiles)


def test_lerobots_statistics_without_quantiles_are_refused(copies: dict[str, Path]) -> None:
    (path,) = copies["lerobot"].glob("policy_preprocessor_step_*")
    tensors = load_file(path)
    del tensors["observation.state.q99"]
    save_file(tensors, path)
    with pytest.raises(CheckpointError, match=r"lacks observation\.state\.q99"):
        read_checkpoint(copies["lerobot"])


@pytest.mark.parametrize("flag", ["use_visual_memory", "use_proprioceptive_memory"])
def test_models_that_remember_are_refused(copies: dict[str, Path], flag: str) -> None:
    _edit(copies["lerobot"] / "config.json", lambda config: config.update({flag: True}))
    with pytest.raises(CheckpointError, match="remembers earlier observations"):
        read_checkpoint(copies["lerobot"])


def test_a_prompt_without_the_state_is_refused(copies: dict[str, Path]) -> None:
    step = {
        "registry_name": "pi05_prepare_state_tokenizer_processor_step",
        "config": {"include_state_in_prompt": False},
    }
    _edit(
        copies["lerobot"] / "policy_preprocessor.json",
        lambda content: content["steps"].append(step),
    )
    with pytest.raises(CheckpointError, match="the prompt lacks the state"):
        read_checkpoint(copies["lerobot"])


def test_weights_of_pi0_under_the_name_of_pi05_are_recognised(
    copies: dict[str, Path], tiny_checkpoint: Path
) -> None:
    shutil.copy(tiny_checkpoint / "model.safetensors", copies["lerobot"])
    with pytest.raises(CheckpointError, match=r"do not fit a pi0\.5 model") as refusal:
        _backend(copies["lerobot"])
    assert "keys of pi0, config.json says pi0.5" in refusal.value.hint


def test_the_state_may_be_left_out_of_the_prompt(made: dict[str, Path], observe: Observe) -> None:
    """As in openpi's pi05_libero: pi0's prompt, and no state at all."""
    with_state = _backend(made["openpi"], noise="fixed")
    without = _backend(made["openpi"], noise="fixed", state_in_prompt=False)
    here, there = observe(), observe(position_m=(0.6, 0.2, 0.3))
    assert (with_state.predict(here).actions != with_state.predict(there).actions).any()
    chunk = without.predict(here)
    np.testing.assert_array_equal(chunk.actions, without.predict(there).actions)
    assert chunk.metrics["prompt_tokens"] < with_state.predict(here).metrics["prompt_tokens"]


@pytest.mark.parametrize("jacobian", ["identity", "full"])
def test_a_running_chunk_is_continued(
    made: dict[str, Path], observe: Observe, jacobian: str
) -> None:
    backend = _backend(made["lerobot"], noise="fixed", rtc_jacobian=jacobian)
    first = backend.predict(observe())
    ahead = Ahead(rows=first.actions, committed_rows=3, step_s=first.step_s, context=first.context)
    free = backend.predict(observe(primary=250))
    bound = backend.predict(replace(observe(primary=250), ahead=ahead))
    assert bound.conditioned_rows == 3
    near = np.abs(bound.context.normalized[:3] - first.context.normalized[:3]).max()
    assert near < 0.5 * np.abs(free.context.normalized[:3] - first.context.normalized[:3]).max()


def test_rows_of_a_trained_prefix_are_kept_as_they_are(
    copies: dict[str, Path], observe: Observe
) -> None:
    _edit(copies["lerobot"] / "config.json", lambda config: config.update(rtc_training_max_delay=2))
    backend = _backend(copies["lerobot"])
    first = backend.predict(observe())
    ahead = Ahead(rows=first.actions, committed_rows=4, step_s=first.step_s, context=first.context)
    second = backend.predict(replace(observe(primary=200), ahead=ahead))
    assert second.conditioned_rows == 2
    np.testing.assert_array_equal(second.context.normalized[:2], first.context.normalized[:2])
