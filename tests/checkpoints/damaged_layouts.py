"""Damages that are specific to one layout of a checkpoint."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from damaged_files import Case, Damage, edited, place, writer

JSON_FILES = {
    "openvla": [
        "config.json",
        "preprocessor_config.json",
        "tokenizer.json",
        "model.safetensors.index.json",
    ],
    "oft": [
        "config.json",
        "preprocessor_config.json",
        "dataset_statistics.json",
        "tokenizer.json",
        "model.safetensors.index.json",
    ],
    "pi0-lerobot": [
        "config.json",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
        "tokenizer.json",
    ],
    "pi0-openpi": ["config.json", "assets/tiny/norm_stats.json", "tokenizer.json"],
}
WEIGHT_FILES = {
    "openvla": ["model-00001-of-00002.safetensors"],
    "oft": ["model-00002-of-00002.safetensors"],
    "pi0-lerobot": [
        "model.safetensors",
        "policy_preprocessor_step_5_normalizer_processor.safetensors",
        "policy_postprocessor_step_0_unnormalizer_processor.safetensors",
    ],
    "pi0-openpi": ["model.safetensors"],
}
HEADS = {"oft": ["action_head--1_checkpoint.pt", "proprio_projector--1_checkpoint.pt"]}


def _openvla() -> Iterator[Case]:
    config, processor, index = (
        "config.json",
        "preprocessor_config.json",
        "model.safetensors.index.json",
    )
    text = "text_config"
    for key, value in (
        ("num_hidden_layers", 4),
        ("num_hidden_layers", 500),
        ("hidden_size", 32),
        ("vocab_size", 32000),
        ("num_attention_heads", 3),
        ("num_key_value_heads", 1),
        ("intermediate_size", 31),
        ("max_position_embeddings", 300_000_000),
        ("max_position_embeddings", 100),
        ("rms_norm_eps", -1.0),
        ("rope_theta", 0),
        ("rope_scaling", {"n" * 10**6: 1}),
        ("model_type", "m" * 10**6),
    ):
        name = f"config.json: {text}.{key} = {str(value)[:40]}"
        yield name, edited(config, lambda d, k=key, v=value: d[text].update({k: v}))
    for key, value in (
        ("pad_to_multiple_of", 63),
        ("pad_to_multiple_of", 128),
        ("model_type", "x" * 10**7),
        ("vision_backbone_id", "x" * 10**6),
        ("vision_backbone_id", "siglip-vit-so400m"),
        ("image_resize_strategy", "letterbox"),
        ("image_sizes", [384, 384]),
        ("tiny_vision_overrides", {"embed_dim": 32, "depth": 3, "num_heads": 0}),
        ("tiny_vision_overrides", {"embed_dim": 32, "depth": 10**9, "num_heads": 2}),
        ("tiny_vision_overrides", None),
    ):
        yield (
            f"config.json: {key} = {str(value)[:50]}",
            edited(config, lambda d, k=key, v=value: d.update({k: v})),
        )
    tower = {"mean": [0.5] * 3, "std": [0.5] * 3}
    for key, value in (
        ("tvf_normalize_params", [tower] * 3),
        ("tvf_normalize_params", [tower]),
        ("tvf_normalize_params", [{"mean": [0.5] * 2, "std": [0.5] * 3}] * 2),
        ("tvf_normalize_params", [{"mean": [0.5] * 3, "std": [0.5, 0, 0.5]}] * 2),
        ("tvf_normalize_params", [{"mean": [0.5] * 3, "std": [0.5, -0.5, 0.5]}] * 2),
        ("tvf_do_letterbox", True),
        ("image_resize_strategy", "letterbox"),
        ("input_sizes", [[3, 384, 384]] * 2),
        ("interpolations", ["bilinear"] * 2),
    ):
        yield (
            f"{processor}: {key} = {value}",
            edited(processor, lambda d, k=key, v=value: d.update({k: v})),
        )
    for shard in (
        "x" * 5000 + ".safetensors",
        "x" * 300,
        "a\0b.safetensors",
        "../model.safetensors",
        ".",
        "",
        "config.json",
    ):
        change = {"language_model.lm_head.weight": shard}
        yield (
            f"{index}: the file {shard[:30]!r}",
            edited(index, lambda d, c=change: d["weight_map"].update(c)),
        )
    yield (
        f"{index}: a name of 7 MB",
        edited(index, lambda d: d["weight_map"].update({"n" * 7_000_000: "m.safetensors"})),
    )
    yield (
        f"{index}: other shard",
        edited(
            index,
            lambda d: d["weight_map"].update(
                {"language_model.lm_head.weight": "model-00001-of-00002.safetensors"}
            ),
        ),
    )


def _ranges(name: str, place: Callable[[Any], Any]) -> Iterator[Case]:
    """Damage to min, max, q01, q99 and mask of one vector."""

    def swap(document: Any) -> None:
        block = place(document)
        block["q01"], block["q99"] = block["q99"], block["q01"]

    yield f"{name}: q01 and q99 swapped", edited(name, swap)
    yield f"{name}: q99 beyond max", edited(name, lambda d: place(d)["q99"].__setitem__(0, 5.0))
    yield f"{name}: too few", edited(name, lambda d: place(d).update(q01=[0.0]))
    yield f"{name}: a million values", edited(name, lambda d: place(d).update(q01=[0.0] * 10**6))
    yield f"{name}: mask too short", edited(name, lambda d: place(d).update(mask=[True]))
    yield f"{name}: no q01", edited(name, lambda d: place(d).pop("q01"))


def openvla_only() -> Iterator[Case]:
    yield from _openvla()
    yield from _ranges("config.json", lambda d: d["norm_stats"]["tiny"]["action"])
    long = edited(
        "config.json", lambda d: d.update(norm_stats={"n" * 10**6: d["norm_stats"]["tiny"]})
    )
    yield "config.json: a data set's name of 1 MB", long
    yield "config.json: no statistics", edited("config.json", lambda d: d.update(norm_stats={}))


def oft() -> Iterator[Case]:
    yield from _openvla()
    yield from _ranges("dataset_statistics.json", lambda d: d["tiny"]["action"])
    yield from _ranges("dataset_statistics.json", lambda d: d["tiny"]["proprio"])
    yield (
        "two heads",
        lambda d: shutil.copy(d / HEADS["oft"][0], d / "action_head--2_checkpoint.pt"),
    )


def _pi0_blocks() -> Iterator[Case]:
    for key in (
        "num_hidden_layers",
        "num_attention_heads",
        "head_dim",
        "hidden_size",
        "num_key_value_heads",
        "vocab_size",
    ):
        for value in (3, 256, 2 * 10**9):
            where = ("vlm_config", "text_config", key)
            yield (
                f"config.json: {'.'.join(where)} = {value}",
                edited("config.json", lambda d, w=where, v=value: place(d, w, v)),
            )
    for key, value in (
        ("vlm_config", None),
        ("dit_config", {}),
        ("type", "x" * 10**7),
        ("min_period", 5.0),
        ("max_period", 0),
    ):
        yield (
            f"config.json: {key} = {str(value)[:40]}",
            edited("config.json", lambda d, k=key, v=value: d.update({k: v})),
        )
    yield (
        "roboneuron.json: a pipe",
        lambda d: ((d / "roboneuron.json").unlink(), os.mkfifo(d / "roboneuron.json"))[1],
    )
    index = {"weight_map": {"a": "x" * 5000}}
    yield "index: a long name", writer("model.safetensors.index.json", json.dumps(index).encode())
    index = {"weight_map": {"a": "../" * 20 + "etc/passwd"}}
    yield (
        "index: another folder",
        writer("model.safetensors.index.json", json.dumps(index).encode()),
    )
    yield "index: nothing", writer("model.safetensors.index.json", b'{"weight_map": {}}')


def lerobot() -> Iterator[Case]:
    yield from _pi0_blocks()
    images = {
        f"observation.images.{i}": {"type": "VISUAL", "shape": [3, 224, 224]} for i in range(1000)
    }
    action = {"action": {"type": "ACTION", "shape": [9]}}
    for key, value in (
        ("input_features", images),
        ("input_features", {}),
        ("output_features", action),
        ("empty_cameras", 10**9),
        ("image_resolution", [10**9, 10**9]),
        ("normalization_mapping", {"STATE": "x" * 10**6}),
    ):
        yield (
            f"config.json: {key} = {str(value)[:40]}",
            edited("config.json", lambda d, k=key, v=value: d.update({k: v})),
        )
    for stage in ("pre", "post"):
        name = f"policy_{stage}processor.json"
        for state_file in ("x" * 5000, "../x", "a\0b", "..", "", None, 5):
            yield (
                f"{name}: state_file = {str(state_file)[:20]!r}",
                edited(name, lambda d, s=state_file: d["steps"][0].update(state_file=s)),
            )
        yield (
            f"{name}: an unknown step of 1 MB",
            edited(name, lambda d: d["steps"].append({"registry_name": "x" * 10**6, "config": {}})),
        )
        yield f"{name}: no steps", edited(name, lambda d: d.update(steps=[]))
    for name in WEIGHT_FILES["pi0-lerobot"][1:]:
        for value in (0.0, -1.0, 1e30):
            yield f"{name}: std {value}", _moments(name, ".std", value)
        yield f"{name}: mean 1e30", _moments(name, ".mean", 1e30)


def _moments(name: str, ending: str, value: float) -> Damage:
    def damage(directory: Path) -> None:
        from safetensors.torch import load_file, save_file

        content = load_file(directory / name)
        for key in content:
            if key.endswith(ending):
                content[key][1] = value
        save_file(content, directory / name)

    return damage


def openpi() -> Iterator[Case]:
    yield from _pi0_blocks()
    name = "assets/tiny/norm_stats.json"
    for part in ("state", "actions"):
        for value in (0.0, -1.0, 1e30, None):
            yield (
                f"{name}: {part}.std[1] = {value}",
                edited(
                    name, lambda d, p=part, v=value: d["norm_stats"][p]["std"].__setitem__(1, v)
                ),
            )
        for values in ([], [1.0] * 10**6, [1.0] * 5, None, "x"):
            yield (
                f"{name}: {part}.std = {str(values)[:20]}",
                edited(name, lambda d, p=part, v=values: d["norm_stats"][p].update(std=v)),
            )
