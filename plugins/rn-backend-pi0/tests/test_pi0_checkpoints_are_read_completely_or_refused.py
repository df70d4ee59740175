"""Every file and tensor of a checkpoint is checked; a mismatch is refused by name."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rn_backend_pi0.layouts import read_checkpoint
from rn_backend_pi0.model import Pi0Model
from rn_backend_pi0.native import Pi0Backend
from rn_backend_pi0.options import Pi0Options
from rn_backend_pi0.weights import load_network
from roboneuron.errors import CheckpointError

PREFIX = "model."


@pytest.fixture
def copy(tiny_checkpoint: Path, tmp_path: Path) -> Path:
    """A checkpoint that may be damaged."""
    return Path(shutil.copytree(tiny_checkpoint, tmp_path / "copy"))


def _load(directory: Path) -> torch.nn.Module:
    dims = read_checkpoint(directory).dims
    return load_network(directory, dims, device=torch.device("cpu"), dtype=torch.float32)


def _edit_weights(directory: Path, edit: Callable[[dict[str, torch.Tensor]], Any]) -> None:
    tensors = load_file(directory / "model.safetensors")
    edit(tensors)
    save_file(tensors, directory / "model.safetensors")


def _edit_json(path: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))


def test_missing_extra_and_misshaped_tensors_are_listed(copy: Path) -> None:
    def edit(tensors: dict[str, torch.Tensor]) -> None:
        del tensors[PREFIX + "state_proj.bias"]
        tensors[PREFIX + "surplus.weight"] = torch.zeros(1)
        tensors[PREFIX + "action_out_proj.bias"] = torch.zeros(7)

    _edit_weights(copy, edit)
    with pytest.raises(CheckpointError) as caught:
        _load(copy)
    for part in (
        "1 missing: state_proj.bias",
        "1 unexpected: surplus.weight",
        r"action_out_proj.bias: (7,), expected (32,)",
    ):
        assert part in str(caught.value)


def test_a_missing_token_embedding_is_named(copy: Path) -> None:
    _edit_weights(copy, lambda t: t.pop(PREFIX + "paligemma_with_expert.paligemma.lm_head.weight"))
    with pytest.raises(CheckpointError, match="lm_head"):
        _load(copy)


def test_the_layer_that_inference_skips_must_still_be_there(copy: Path) -> None:
    key = (
        PREFIX + "paligemma_with_expert.paligemma.model.language_model.layers.1.mlp.up_proj.weight"
    )
    _edit_weights(copy, lambda t: t.pop(key))
    with pytest.raises(CheckpointError, match="up_proj"):
        _load(copy)


def test_pi05_weights_are_recognised(copy: Path) -> None:
    def edit(tensors: dict[str, torch.Tensor]) -> None:
        for part in ("in", "out"):
            for leaf in ("weight", "bias"):
                tensors[f"{PREFIX}time_mlp_{part}.{leaf}"] = tensors.pop(
                    f"{PREFIX}action_time_mlp_{part}.{leaf}"
                )

    _edit_weights(copy, edit)
    with pytest.raises(CheckpointError, match=r"pi0\.5"):
        _load(copy)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(copy: Path, bad: float) -> None:
    _edit_weights(copy, lambda t: t[PREFIX + "state_proj.bias"].fill_(bad))
    with pytest.raises(CheckpointError, match=r"state_proj\.bias"):
        _load(copy)


def test_a_weight_that_inference_never_reads_is_checked_as_well(copy: Path) -> None:
    key = (
        PREFIX + "paligemma_with_expert.paligemma.model.language_model.layers.1.mlp.up_proj.weight"
    )
    _edit_weights(copy, lambda t: t[key].fill_(float("nan")))
    with pytest.raises(CheckpointError, match=r"up_proj.*not finite"):
        _load(copy)


def test_a_truncated_file_is_refused(copy: Path) -> None:
    path = copy / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(CheckpointError, match="truncated"):
        _load(copy)


def test_absent_weights_are_refused(copy: Path) -> None:
    (copy / "model.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors does not exist"):
        _load(copy)


def test_shards_and_plain_keys_give_the_same_network(copy: Path, tiny_checkpoint: Path) -> None:
    tensors = {
        key.removeprefix(PREFIX): value
        for key, value in load_file(copy / "model.safetensors").items()
    }
    (copy / "model.safetensors").unlink()
    head = "paligemma_with_expert.paligemma.lm_head.weight"
    tensors["paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"] = (
        tensors.pop(head)
    )
    keys = sorted(tensors)
    parts = {
        "model-00001-of-00002.safetensors": keys[:40],
        "model-00002-of-00002.safetensors": keys[40:],
    }
    for name, part in parts.items():
        save_file({key: tensors[key] for key in part}, copy / name)
    weight_map = {key: name for name, part in parts.items() for key in part}
    (copy / "model.safetensors.index.json").write_text(json.dumps({"weight_map": weight_map}))
    sharded, whole = _load(copy).state_dict(), _load(tiny_checkpoint).state_dict()
    assert sharded.keys() == whole.keys()
    assert all(torch.equal(sharded[name], whole[name]) for name in whole)


def test_a_shard_that_is_missing_is_named(copy: Path) -> None:
    (copy / "model.safetensors.index.json").write_text(
        json.dumps({"weight_map": {"a": "model-2.safetensors"}})
    )
    with pytest.raises(CheckpointError, match=r"model-2\.safetensors does not exist"):
        _load(copy)


@pytest.mark.parametrize(
    ("kind", "advice"),
    [
        ("act", "Choose a backend that runs it: lerobot"),
        ("smolvla", "Choose a backend that runs it: lerobot"),
        ("openvla", "Choose a backend that runs it: openvla (OpenVLA), oft (OpenVLA-OFT)."),
    ],
)
def test_another_family_is_refused_by_name(copy: Path, kind: str, advice: str) -> None:
    _edit_json(copy / "config.json", lambda c: c.update(type=kind))
    with pytest.raises(CheckpointError, match=kind) as refusal:
        read_checkpoint(copy)
    assert refusal.value.hint.startswith(advice)


def test_a_directory_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="not a directory"):
        read_checkpoint(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match=r"config\.json"):
        read_checkpoint(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match="action_horizon"):
        read_checkpoint(tmp_path)
    (tmp_path / "config.json").write_text("[1]")
    with pytest.raises(CheckpointError, match="expected an object"):
        read_checkpoint(tmp_path)


def test_an_unknown_processing_step_is_refused(copy: Path) -> None:
    path = copy / "policy_preprocessor.json"
    _edit_json(path, lambda d: d["steps"].append({"registry_name": "mirror_actions", "config": {}}))
    with pytest.raises(CheckpointError, match="mirror_actions"):
        read_checkpoint(copy)


def test_the_statistics_are_found_by_their_state_file_whatever_the_step_number(copy: Path) -> None:
    old = copy / "policy_preprocessor_step_5_normalizer_processor.safetensors"
    expected = read_checkpoint(copy).state.mean
    old.rename(copy / "policy_preprocessor_step_2_normalizer_processor.safetensors")
    with pytest.raises(CheckpointError, match="step_5"):
        read_checkpoint(copy)
    _edit_json(
        copy / "policy_preprocessor.json",
        lambda d: d["steps"][0].update(
            state_file="policy_preprocessor_step_2_normalizer_processor.safetensors"
        ),
    )
    np.testing.assert_array_equal(read_checkpoint(copy).state.mean, expected)


def test_a_state_file_outside_the_directory_is_refused(copy: Path) -> None:
    _edit_json(
        copy / "policy_preprocessor.json", lambda d: d["steps"][0].update(state_file="../../secret")
    )
    with pytest.raises(CheckpointError, match="state_file"):
        read_checkpoint(copy)


def test_quantile_normalisation_is_refused(copy: Path) -> None:
    _edit_json(copy / "config.json", lambda c: c["normalization_mapping"].update(STATE="QUANTILES"))
    with pytest.raises(CheckpointError, match="QUANTILES"):
        read_checkpoint(copy)


def test_a_lerobot_checkpoint_without_processors_says_how_to_migrate(copy: Path) -> None:
    for path in copy.glob("policy_*"):
        path.unlink()
    with pytest.raises(CheckpointError, match="migrat"):
        read_checkpoint(copy)


def test_statistics_that_are_not_numbers_are_refused(
    tiny_openpi_checkpoint: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(tiny_openpi_checkpoint, tmp_path / "copy"))
    path = copy / "assets" / "tiny" / "norm_stats.json"
    original = path.read_text()
    for bad in ([float("nan")] * 8, ["x"] * 8, [1.0, 2.0], [], None, [-1.0] * 8):
        path.write_text(original)
        _edit_json(path, lambda d, bad=bad: d["norm_stats"]["state"].update(std=bad))  # type: ignore[misc]
        with pytest.raises(CheckpointError, match=r"norm_stats\.json"):
            read_checkpoint(copy)


def test_the_assets_of_an_openpi_checkpoint_are_chosen_by_name(
    tiny_openpi_checkpoint: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(tiny_openpi_checkpoint, tmp_path / "copy"))
    shutil.copytree(copy / "assets" / "tiny", copy / "assets" / "lab" / "other")
    with pytest.raises(CheckpointError, match=r"tiny.*lab/other"):
        read_checkpoint(copy)
    with pytest.raises(CheckpointError, match="nothing"):
        read_checkpoint(copy, asset_id="nothing")
    assert read_checkpoint(copy, asset_id="lab/other").state.width == 8
    shutil.rmtree(copy / "assets")
    with pytest.raises(CheckpointError, match=r"norm_stats\.json"):
        read_checkpoint(copy)


def test_the_variant_names_of_released_checkpoints_give_their_sizes(copy: Path) -> None:
    def edit(config: dict[str, Any]) -> None:
        del config["vlm_config"], config["dit_config"]
        config.update(
            paligemma_variant="gemma_2b", action_expert_variant="gemma_300m", chunk_size=50
        )

    _edit_json(copy / "config.json", edit)
    dims = read_checkpoint(copy).dims
    assert (dims.prefix.width, dims.expert.width, dims.vision.depth, dims.vocabulary) == (
        2048,
        1024,
        27,
        257_152,
    )
    _edit_json(copy / "config.json", lambda c: c.update(paligemma_variant="gemma_2b_lora"))
    with pytest.raises(CheckpointError, match="LoRA"):
        read_checkpoint(copy)


def test_the_openpi_layout_of_the_golden_weights_gives_the_golden_actions(
    golden_directory: Path, golden: dict[str, np.ndarray], tmp_path: Path
) -> None:
    tensors = load_file(golden_directory / "model.safetensors")
    save_file(
        {key.removeprefix(PREFIX): value for key, value in tensors.items()},
        tmp_path / "model.safetensors",
    )
    blocks = json.loads((golden_directory / "config.json").read_text())
    config = {
        "action_dim": 32,
        "action_horizon": 10,
        **{k: blocks[k] for k in ("vlm_config", "dit_config")},
    }
    (tmp_path / "config.json").write_text(json.dumps(config))
    assets = tmp_path / "assets" / "physical" / "tiny"
    assets.mkdir(parents=True)
    shutil.copy(golden_directory / "norm_stats.json", assets)
    model = Pi0Model(read_checkpoint(tmp_path), device="cpu", dtype="float32", cpu_threads=1)
    tokens = golden["in/prompt_tokens"][golden["in/prompt_mask"]].tolist()
    images = [golden["in/image_base"], golden["in/image_wrist"], None]
    out = model.infer(images, tokens, golden["in/state_raw"], golden["in/noise"][0])
    np.testing.assert_allclose(out, golden["out/main/actions_norm_openpi"], atol=2e-5, rtol=0)


@pytest.mark.parametrize(("column", "refused"), [(3, True), (6, False), (7, True)])
def test_only_the_padding_column_of_bridge_may_have_no_spread(
    tiny_openpi_checkpoint: Path, tmp_path: Path, column: int, refused: bool
) -> None:
    copy = Path(shutil.copytree(tiny_openpi_checkpoint, tmp_path / "copy"))
    path = copy / "assets" / "tiny" / "norm_stats.json"
    _edit_json(path, lambda d: d["norm_stats"]["state"]["std"].__setitem__(column, 0.0))
    backend = Pi0Backend(Pi0Options(checkpoint=copy, device="cpu", profile="bridge"))
    if refused:
        with pytest.raises(CheckpointError, match=rf"the state values {column} \("):
            backend.load()
    else:
        backend.load()
    backend.close()


def test_a_tokenizer_with_ids_beyond_the_embedding_is_refused_when_it_is_loaded(copy: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        document["model"]["vocab"]["zebra"] = 5000

    _edit_json(copy / "tokenizer.json", edit)
    with pytest.raises(CheckpointError, match="knows the id 5000, the model has 640 embeddings"):
        Pi0Backend(Pi0Options(checkpoint=copy, device="cpu", profile="libero")).load()
