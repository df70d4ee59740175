from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from tokenizers import Tokenizer

from rn_backend_openvla.backend import OpenVlaBackend
from rn_backend_openvla.cli import main
from rn_backend_openvla.config import OpenVlaConfig
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.runtime import TorchRuntime
from rn_vla.decoding import DecoderShape
from rn_vla.openvla.checkpoint import BACKBONES, OpenvlaCheckpoint
from rn_vla.openvla.layout import VisionShape, expected_weights
from rn_vla.openvla.prompt import PromptEncoder, end_prompt
from rn_vla.openvla.tiny import make_tiny, write_tokenizer
from roboneuron.errors import CheckpointError, ConfigurationError


def _load(path, **options) -> OpenVlaBackend:
    config = OpenVlaConfig(checkpoint=path, **({"profile": "libero"} | options))
    backend = OpenVlaBackend(
        config, runtime=TorchRuntime(TorchRuntimeConfig(device="cpu", dtype="float32"))
    )
    backend.load()
    return backend


@pytest.fixture
def complete(golden_copy):
    """The golden checkpoint with a tokenizer."""
    write_tokenizer(golden_copy / "tokenizer.json")
    return golden_copy


def _edit(path, **changes):
    content = json.loads(path.read_text())
    content.update(changes)
    path.write_text(json.dumps(content))


def test_a_complete_public_layout_loads(complete):
    _load(complete)


@pytest.mark.parametrize(
    ("config", "family", "advice"),
    [
        ({"type": "pi0"}, "'pi0'", "Choose a backend that runs it: pi0."),
        ({"model_type": "llama"}, "'llama'", "No backend of RoboNeuron runs that family"),
        ({}, "None", "No backend of RoboNeuron runs that family"),
        (["x"], "None", "No backend of RoboNeuron runs that family"),
    ],
)
def test_a_checkpoint_of_another_family_is_named(complete, config, family, advice):
    (complete / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=rf"family {family}, expected 'openvla'") as refusal:
        _load(complete)
    assert refusal.value.hint.startswith(advice)


def test_an_oft_checkpoint_is_sent_to_its_own_backend(complete):
    (complete / "action_head--5_checkpoint.pt").write_bytes(b"")
    with pytest.raises(CheckpointError, match="Use the backend 'oft'"):
        _load(complete)


def test_a_missing_directory_is_named(tmp_path):
    with pytest.raises(CheckpointError, match="is not a directory"):
        _load(tmp_path / "nowhere")


@pytest.mark.parametrize(
    "name", ["config.json", "preprocessor_config.json", "tokenizer.json", "model.safetensors"]
)
def test_a_missing_file_is_named(complete, name):
    (complete / name).unlink()
    with pytest.raises(CheckpointError, match=rf"{name} does not exist"):
        _load(complete)


@pytest.mark.parametrize(
    "name", ["config.json", "preprocessor_config.json", "tokenizer.json", "dataset_statistics.json"]
)
def test_a_damaged_json_file_is_named(complete, name):
    (complete / name).write_text('{"half": ')
    with pytest.raises(CheckpointError, match=name):
        _load(complete)


def test_missing_extra_and_misshaped_weights_are_listed(complete):
    path = complete / "model.safetensors"
    tensors = load_file(path)
    tensors["projector.fc4.weight"] = tensors.pop("projector.fc3.bias")
    name = "vision_backbone.featurizer.blocks.2.mlp.fc1.bias"  # of the block that is never run
    tensors[name] = tensors[name][:-1].contiguous()
    save_file(tensors, path)
    with pytest.raises(CheckpointError) as caught:
        _load(complete)
    assert "1 missing: projector.fc3.bias" in str(caught.value)
    assert "1 unexpected: projector.fc4.weight" in str(caught.value)
    assert f"{name} is [127], expected [128]" in str(caught.value)


def test_a_truncated_weight_file_is_named(complete):
    path = complete / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(CheckpointError, match=r"model\.safetensors .*truncated or damaged"):
        _load(complete)


@pytest.mark.parametrize(
    "name",
    ["projector.fc1.bias", "vision_backbone.featurizer.blocks.2.mlp.fc1.bias"],
    ids=["used", "of the block that is never run"],
)
def test_nan_in_a_weight_is_named(complete, name):
    path = complete / "model.safetensors"
    tensors = load_file(path)
    tensors[name][7] = torch.nan
    save_file(tensors, path)
    with pytest.raises(CheckpointError, match=rf"NaN .*{re.escape(name)}"):
        _load(complete)


def test_an_index_that_lacks_a_tensor_is_refused_with_its_name(tmp_path):
    make_tiny(tmp_path / "tiny")
    index = tmp_path / "tiny" / "model.safetensors.index.json"
    content = json.loads(index.read_text())
    del content["weight_map"]["language_model.model.norm.weight"]
    content["weight_map"]["stranger"] = "model-00001-of-00002.safetensors"
    index.write_text(json.dumps(content))
    with pytest.raises(
        CheckpointError,
        match=r"1 missing \(language_model.model.norm.weight\), 1 unexpected \(stranger\)",
    ):
        _load(tmp_path / "tiny")


def test_an_index_that_leaves_the_directory_is_refused(tmp_path):
    make_tiny(tmp_path / "tiny")
    index = tmp_path / "tiny" / "model.safetensors.index.json"
    index.write_text(index.read_text().replace("model-00002-of", "../model-00002-of"))
    with pytest.raises(CheckpointError, match="outside its directory"):
        _load(tmp_path / "tiny")


def test_a_wrong_data_set_is_refused_with_the_choices(complete):
    with pytest.raises(ConfigurationError, match=r"'libero_spatial'.*Choose one of: toy_suite"):
        _load(complete, unnorm_key="libero_spatial")


def test_several_data_sets_need_a_choice(complete):
    stats = json.loads((complete / "config.json").read_text())["norm_stats"]
    _edit(complete / "config.json", norm_stats={**stats, "other": stats["toy_suite"]})
    with pytest.raises(ConfigurationError, match=r"not set.*2 data sets.*other, toy_suite"):
        _load(complete)
    _load(complete, unnorm_key="other")


def test_dataset_statistics_replace_those_of_the_configuration(complete):
    stats = json.loads((complete / "config.json").read_text())["norm_stats"]
    (complete / "dataset_statistics.json").write_text(
        json.dumps({"fine_tuned": stats["toy_suite"]})
    )
    with pytest.raises(
        ConfigurationError, match=r"dataset_statistics\.json.*Choose one of: fine_tuned"
    ):
        _load(complete, unnorm_key="toy_suite")
    _load(complete, unnorm_key="fine_tuned")


def test_statistics_of_another_width_are_refused(complete):
    config = json.loads((complete / "config.json").read_text())
    action = config["norm_stats"]["toy_suite"]["action"]
    for name, values in action.items():
        action[name] = values[:6]
    _edit(complete / "config.json", norm_stats=config["norm_stats"])
    with pytest.raises(ConfigurationError, match="6 action values"):
        _load(complete)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vision_backbone_id": "clip-vit-l"}, "'clip-vit-l', expected one of dinosiglip"),
        (
            {"image_resize_strategy": "letterbox"},
            r"config.json: image_resize_strategy is 'letterbox', only",
        ),
        ({"text_config": {"model_type": "mistral"}}, "model_type is 'mistral'"),
        ({"text_config": {"rope_scaling": {"factor": 2.0}}}, "rope_scaling"),
    ],
)
def test_what_is_not_implemented_is_refused_and_not_approximated(complete, changes, words):
    _edit(complete / "config.json", **changes)
    with pytest.raises(CheckpointError, match=words):
        _load(complete)


def test_pixel_normalisation_follows_the_cached_values_of_the_processor(golden_checkpoint):
    """The keys `means` and `stds` are rounded differently and were not used in training."""
    assert golden_checkpoint.towers[0].mean == (0.484375, 0.455078125, 0.40625)


def test_the_first_release_has_one_tower_and_another_prompt(tmp_path):
    make_tiny(tmp_path / "v01")
    for name in ("model.safetensors.index.json",):
        (tmp_path / "v01" / name).unlink()
    tower = {"mean": [0.5] * 3, "std": [0.5] * 3}
    _edit(
        tmp_path / "v01" / "config.json",
        vision_backbone_id="siglip-vit-so400m",
        llm_backbone_id="vicuna-v15-7b",
    )
    _edit(tmp_path / "v01" / "preprocessor_config.json", tvf_normalize_params=[tower])
    checkpoint = OpenvlaCheckpoint.read(tmp_path / "v01")
    assert checkpoint.is_vicuna
    assert checkpoint.vision.projector == (32, 16, 16)
    encoder = PromptEncoder(
        tmp_path / "v01" / "tokenizer.json", "v01", base=32000, embeddings=32064
    )
    assert encoder.to_text("Go").endswith(
        "USER: What action should the robot take to go? ASSISTANT:"
    )


def test_ids_are_those_of_the_tokenizer_file_and_the_final_one_is_added_once(tmp_path):
    write_tokenizer(tmp_path / "tokenizer.json")
    encoder = PromptEncoder(tmp_path / "tokenizer.json", "v02", base=32000, embeddings=32064)
    text = encoder.to_text("pick up the cube")
    plain = Tokenizer.from_file(str(tmp_path / "tokenizer.json")).encode(text).ids
    assert encoder.to_ids(text).tolist() == [*plain, 29871]
    assert end_prompt(np.array([1, 5, 29871])).tolist() == [1, 5, 29871]


def test_make_tiny_writes_a_checkpoint_that_loads(tmp_path, capsys):
    assert main(["make-tiny", str(tmp_path / "made"), "--seed", "4"]) == 0
    assert 'unnorm_key = "tiny"' in capsys.readouterr().out
    _load(tmp_path / "made", unnorm_key="tiny")


def test_make_tiny_does_not_write_into_a_full_directory(tmp_path, capsys):
    (tmp_path / "precious").write_text("x")
    assert main(["make-tiny", str(tmp_path)]) == 2
    assert "not an empty directory" in capsys.readouterr().err


def test_expected_weights_of_the_public_model_are_as_many_as_it_has():
    """Counts of openvla-7b: keys and parameters per part, and in all."""
    decoder = DecoderShape(
        hidden=4096,
        intermediate=11008,
        layers=32,
        heads=32,
        key_value_heads=32,
        vocabulary=32064,
        norm_epsilon=1e-6,
        rope_theta=10000.0,
        max_positions=2048,
    )
    vision = VisionShape(towers=BACKBONES["dinosiglip-vit-so-224px"], hidden=4096)
    weights = expected_weights(vision, decoder)

    def count(prefix: str) -> tuple[int, int]:
        shapes = [weight.shape for name, weight in weights.items() if name.startswith(prefix)]
        return len(shapes), sum(math.prod(shape) for shape in shapes)

    assert count("vision_backbone.featurizer.") == (343, 303_230_976)
    assert count("vision_backbone.fused_featurizer.") == (342, 427_680_704)
    assert round(count("projector.")[1] / 1e6, 1) == 71.4
    assert round(count("")[1] / 1e9, 3) == 7.541


def test_letterbox_in_the_processor_is_named_as_such(complete):
    """The message used to name the strategy of the other file: resizes by 'resize-naive', only
    'resize-naive' ...
    """
    _edit(complete / "preprocessor_config.json", tvf_do_letterbox=True)
    with pytest.raises(
        CheckpointError, match=r"preprocessor_config\.json: tvf_do_letterbox is true"
    ):
        _load(complete)
    _edit(
        complete / "preprocessor_config.json",
        tvf_do_letterbox=False,
        image_resize_strategy="letterbox",
    )
    with pytest.raises(
        CheckpointError, match=r"preprocessor_config\.json: image_resize_strategy is 'letterbox'"
    ):
        _load(complete)


def test_limits_out_of_order_are_refused_for_the_chosen_data_set_only(complete):
    stats = json.loads((complete / "config.json").read_text())["norm_stats"]["toy_suite"]
    swapped = json.loads(json.dumps(stats))
    swapped["action"]["q01"], swapped["action"]["q99"] = (
        stats["action"]["q99"],
        stats["action"]["q01"],
    )
    _edit(complete / "config.json", norm_stats={"good": stats, "bad": swapped})
    _load(complete, unnorm_key="good")
    with pytest.raises(
        CheckpointError, match=r"'bad', action, do not hold min <= q01 <= q99 <= max at value 0"
    ):
        _load(complete, unnorm_key="bad")


def test_action_tokens_are_counted_from_where_the_tokenizer_ends(complete):
    _edit(complete / "config.json", pad_to_multiple_of=63)
    with pytest.raises(CheckpointError, match=r"has 32000 ids, config\.json says 32001"):
        _load(complete)
