"""Tiny random checkpoints in the public layout: a few megabytes that load and run like real ones.

Nothing is downloaded; the tokenizer is created locally. Their actions are meaningless, but depend
on image and prompt.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rn_vla.decoding import Weight
from rn_vla.openvla.checkpoint import OpenvlaCheckpoint
from rn_vla.openvla.prompt import BOS_ID, FINAL_ID, save_tokenizer
from roboneuron import ConfigurationError

VOCABULARY = 32064
_PADDED_FROM = 32000
_ACTION_BINS = 256
_HIDDEN = 16
STATISTICS_KEY = "tiny"
"""Name of the one data set in the statistics."""
_WORDS = (
    "In : What action should the robot take to ? Out pick up put on in of bowl cube red "
    "green blue plate box and"
)


def make_tiny(path: Path, *, seed: int = 0, proprio_width: int = 8) -> None:
    """Write a checkpoint of two shards into the new or empty directory `path`.

    Args:
        path: destination.
        seed: seed of the random weights.
        proprio_width: values of proprioception in the statistics.

    Raises:
        ConfigurationError: the directory is not empty.
    """
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise ConfigurationError(
            f"{path} exists and is not an empty directory.", hint="Name a new directory."
        )
    path.mkdir(parents=True, exist_ok=True)
    _write_json(path / "config.json", _config(proprio_width))
    _write_json(path / "preprocessor_config.json", _processor())
    write_tokenizer(path / "tokenizer.json")
    _write_weights(path, seed)


def _write_json(path: Path, content: object) -> None:
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _config(proprio_width: int) -> Mapping[str, object]:
    return {
        "architectures": ["OpenVLAForActionPrediction"],
        "model_type": "openvla",
        "vision_backbone_id": "dinosiglip-vit-so-224px",
        "llm_backbone_id": "llama2-7b-pure",
        "image_resize_strategy": "resize-naive",
        "pad_token_id": _PADDED_FROM,
        "pad_to_multiple_of": VOCABULARY - _PADDED_FROM,
        "n_action_bins": _ACTION_BINS,
        "torch_dtype": "bfloat16",
        "text_config": {
            "model_type": "llama",
            "hidden_size": _HIDDEN,
            "intermediate_size": 32,
            "num_hidden_layers": 3,
            "num_attention_heads": 2,
            "vocab_size": VOCABULARY,
        },
        "norm_stats": {STATISTICS_KEY: tiny_statistics(proprio_width)},
        "tiny_vision_overrides": {"embed_dim": 32, "depth": 3, "num_heads": 2},
    }


def tiny_statistics(proprio_width: int) -> Mapping[str, object]:
    """Statistics of one data set: moves of up to a fifth of a unit, an absolute gripper,
    proprioception within 2.
    """
    reach = [0.2] * 6 + [1.0]
    wide = [2.0] * proprio_width
    return {
        "action": _ranges(reach, [True] * 6 + [False]),
        "proprio": _ranges(wide, [True] * proprio_width),
        "num_transitions": 1,
        "num_trajectories": 1,
    }


def _ranges(reach: list[float], mask: list[bool]) -> Mapping[str, object]:
    below = [-value for value in reach]
    still, unit = [0.0] * len(reach), [1.0] * len(reach)
    return {
        "min": below,
        "max": reach,
        "q01": below,
        "q99": reach,
        "mean": still,
        "std": unit,
        "mask": mask,
    }


def _processor() -> Mapping[str, object]:
    mean, std = [0.484375, 0.455078125, 0.40625], [0.228515625, 0.2236328125, 0.224609375]
    return {
        "image_processor_type": "PrismaticImageProcessor",
        "image_resize_strategy": "resize-naive",
        "input_sizes": [[3, 224, 224]] * 2,
        "tvf_do_letterbox": False,
        "tvf_normalize_params": [{"mean": mean, "std": std}, {"mean": [0.5] * 3, "std": [0.5] * 3}],
    }


def write_tokenizer(path: Path) -> None:
    """Write a Llama-like tokenizer: 32000 ids, bytes for unknown characters, the same special
    ids.
    """
    vocabulary = {"<unk>": 0, "<s>": BOS_ID, "</s>": 2}
    vocabulary |= {f"<0x{byte:02X}>": 3 + byte for byte in range(256)}
    merges: list[tuple[str, str]] = []
    pieces = [chr(code) for code in range(33, 127)]
    for word in _WORDS.split():
        built = "▁"
        for letter in word:
            merges.append((built, letter))
            built += letter
            pieces.append(built)
    for piece in dict.fromkeys(pieces):
        vocabulary[piece] = len(vocabulary)
    vocabulary |= {
        f"<unused_{index}>": index
        for index in range(len(vocabulary), _PADDED_FROM)
        if index != FINAL_ID
    }
    vocabulary["▁"] = FINAL_ID
    save_tokenizer(path, vocabulary, merges)


def _write_weights(path: Path, seed: int) -> None:
    import torch  # heavy
    from safetensors.torch import save_file

    generator = np.random.default_rng(seed)
    weights = OpenvlaCheckpoint.read(path).shards[0].weights
    files = ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")
    placed = {name: files[name.startswith("language_model.")] for name in weights}
    for file in files:
        tensors = {
            name: torch.from_numpy(random_values(name, weight, generator)).to(torch.bfloat16)
            for name, weight in weights.items()
            if placed[name] == file
        }
        save_file(tensors, path / file, metadata={"format": "pt"})
    _write_json(path / "model.safetensors.index.json", {"metadata": {}, "weight_map": placed})


def random_values(
    name: str, weight: Weight, generator: np.random.Generator
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Random float32 values scaled so that signals neither vanish nor grow; only action tokens are
    ever likely.
    """
    values = generator.standard_normal(weight.shape).astype(np.float32)
    if len(weight.shape) == 1:
        is_bias = name.endswith(".bias")
        return values * np.float32(0.1) if is_bias else np.float32(1.0) + values * np.float32(0.1)
    if name.endswith("lm_head.weight"):
        values[: _PADDED_FROM - _ACTION_BINS] = 0
        values[_PADDED_FROM:] = 0
        return values
    if name.endswith("embed_tokens.weight") or "_token" in name:
        return values
    if name.endswith("pos_embed"):
        return values * np.float32(0.2)
    fan_in = float(np.prod(weight.shape[1:]))
    return values * np.float32(fan_in**-0.5)
