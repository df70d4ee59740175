"""A tiny random checkpoint of the pi0 family in a public layout, to test the software; useless on a
robot.
"""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from tokenizers import (
    AddedToken,
    Tokenizer,
    decoders,
    models,
    normalizers,
    pre_tokenizers,
    trainers,
)

from rn_backend_pi0.architecture import (
    EMBEDDING_KEYS,
    GemmaDims,
    Pi0Dims,
    Variant,
    VisionDims,
    optional_tensors,
    required_tensors,
)
from rn_backend_pi0.checkpoint import PROFILE_FILE, Family
from rn_backend_pi0.fast_tokens import FAST_DIRECTORY, cosines
from rn_backend_pi0.layouts import OPENPI_SLOTS
from rn_backend_pi0.prompt import TOKENIZER_FILE
from rn_backend_pi0.tiny_statistics import TINY_PROFILES, Block, tiny_statistics
from roboneuron import ConfigurationError

TINY_SKIP_TOKENS = 4
_SCALE, _LEAST, _GREATEST = 10.0, -48, 48
_VOCABULARY = 128
_CHUNKS = 200


def write_fast_tokenizer(checkpoint: Path, *, horizon: int, width: int) -> None:
    """Write processor_config.json and tokenizer.json, trained on random smooth chunks, to the
    tokenizer folder of the checkpoint. Every token consists of whole coefficients.
    """
    directory = checkpoint / FAST_DIRECTORY
    directory.mkdir()
    tokenizer = Tokenizer(models.BPE())
    byte_level = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.pre_tokenizer, tokenizer.decoder = byte_level, decoders.ByteLevel()
    letters = [chr(code) for code in range(_GREATEST - _LEAST + 1)]
    alphabet = ["".join(piece for piece, _ in byte_level.pre_tokenize_str(c)) for c in letters]
    trainer = trainers.BpeTrainer(
        vocab_size=_VOCABULARY, initial_alphabet=alphabet, special_tokens=[], show_progress=False
    )
    tokenizer.train_from_iterator(_texts(horizon, width), trainer)
    tokenizer.save(str(directory / "tokenizer.json"))
    config = {
        "processor_class": "UniversalActionProcessor",
        "scale": _SCALE,
        "vocab_size": _VOCABULARY,
        "min_token": _LEAST,
        "time_horizon": horizon,
        "action_dim": width,
    }
    (directory / "processor_config.json").write_text(json.dumps(config, indent=2) + "\n")


def _texts(horizon: int, width: int) -> list[str]:
    random = np.random.default_rng(3)
    matrix = cosines(horizon)
    texts = []
    for _ in range(_CHUNKS):
        steps = random.normal(0.0, 0.2, (horizon, width)).cumsum(axis=0)
        rounded = np.around(matrix @ steps.clip(-1.0, 1.0) * _SCALE).clip(_LEAST, _GREATEST)
        texts.append("".join(chr(int(value) - _LEAST) for value in rounded.flatten()))
    return texts


TINY = Pi0Dims(
    vision=VisionDims(width=32, depth=2, mlp=64, heads=4),
    prefix=GemmaDims(width=32, depth=2, mlp=64, heads=4, kv_heads=1, head_dim=16),
    expert=GemmaDims(width=16, depth=2, mlp=32, heads=4, kv_heads=1, head_dim=16),
    vocabulary=640,
    chunk=10,
)
"""Dimensions of the tiny model; the layout is that of the released ones."""
_SENTENCES = (
    "pick up the red cube and place it on the green plate",
    "put the blue bowl into the open drawer and close it",
    "move the gripper to the left, then to the right, above the table",
    "push the white mug to the front of the stove and turn on the stove",
    "open the top drawer of the cabinet, stack the yellow block on the black box",
    "reach for the apple, lift the bottle, wipe the counter, stop and go home",
)
_ACTIVATION = "gelu_pytorch_tanh"


def make_tokenizer(vocabulary: int) -> Tokenizer:
    """A byte-complete BPE tokenizer with PaliGemma's special tokens, trained on six sentences."""
    tokenizer = Tokenizer(models.BPE(byte_fallback=False))
    tokenizer.normalizer = normalizers.NFC()
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    trainer = trainers.BpeTrainer(
        vocab_size=vocabulary - 1,
        special_tokens=["<pad>", "<eos>", "<bos>", "<unk>"],
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator(_SENTENCES, trainer)
    tokenizer.add_tokens([AddedToken("\n", normalized=False)])
    return tokenizer


def make_tiny(
    directory: Path,
    *,
    layout: Family = "lerobot",
    seed: int = 0,
    variant: Variant = "pi0",
    profile: str = "libero",
) -> None:
    """Write a complete tiny checkpoint into `directory`.

    Args:
        directory: new or empty.
        layout: "lerobot" or "openpi".
        seed: seed of the weights.
        variant: "pi0", "pi05", or "pi0_fast" (only in LeRobot's layout).
        profile: one of `TINY_PROFILES`, which the checkpoint then names.

    Raises:
        ConfigurationError: there is no such profile or layout, or the directory is not empty or not
            writable.
    """
    if profile not in TINY_PROFILES:
        raise ConfigurationError(
            f"There is no tiny checkpoint of profile {profile!r}; choose one of "
            f"{', '.join(TINY_PROFILES)}."
        )
    if variant == "pi0_fast" and layout != "lerobot":
        raise ConfigurationError("openpi has no PyTorch layout of pi0_fast; choose 'lerobot'.")
    dims, statistics = replace(TINY, variant=variant), tiny_statistics(profile, variant)
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise ConfigurationError(
            f"{directory} exists and is not an empty directory; choose another."
        )
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _write_weights(directory, dims, layout, seed)
        make_tokenizer(TINY.vocabulary).save(str(directory / TOKENIZER_FILE))
        _write_json(directory / PROFILE_FILE, {"profile": profile})
        if variant == "pi0_fast":
            width = len(statistics[1]["mean"])
            write_fast_tokenizer(directory, horizon=dims.chunk, width=width)
        if layout == "lerobot":
            _write_lerobot(directory, variant, statistics)
        else:
            _write_openpi(directory, statistics)
    except OSError as error:
        raise ConfigurationError(f"{directory} cannot be written: {error}.") from error


def _write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def _write_weights(directory: Path, dims: Pi0Dims, layout: Family, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    shapes = required_tensors(dims) | {EMBEDDING_KEYS[0]: (dims.vocabulary, dims.prefix.width)}
    shapes |= dict(list(optional_tensors(dims).items())[:1])
    tensors: dict[str, torch.Tensor] = {}
    for key, shape in shapes.items():
        values = torch.randn(shape, generator=generator)
        if key.endswith(".dense.weight"):
            values = values / float(shape[1]) ** 0.5
        elif key.endswith(".bias") or "norm" in key:
            values = values * 0.1 + (1.0 if "layer_norm" in key or "post_layernorm" in key else 0.0)
            if key.endswith(".bias"):
                values = values * 0.1
        elif "lm_head" in key:
            values = values / dims.prefix.width**0.5
            if dims.variant == "pi0_fast":
                values = values * 0.1  # the head is tied: a larger one repeats the last token
        else:
            values = values / float(np.prod(shape[1:])) ** 0.5
        if dims.variant == "pi0_fast" and key.endswith(("q_proj.weight", "k_proj.weight")):
            values = values * 3.0  # so that attention is not spread evenly over all images
        prefix = "model." if layout == "lerobot" else ""
        tensors[prefix + key] = values.to(torch.bfloat16)
    save_file(tensors, directory / "model.safetensors", metadata={"format": "pt"})


def _gemma_block(dims: GemmaDims) -> dict[str, object]:
    return {
        "model_type": "gemma",
        "vocab_size": TINY.vocabulary,
        "hidden_size": dims.width,
        "num_hidden_layers": dims.depth,
        "intermediate_size": dims.mlp,
        "num_attention_heads": dims.heads,
        "num_key_value_heads": dims.kv_heads,
        "head_dim": dims.head_dim,
        "hidden_activation": _ACTIVATION,
        "rms_norm_eps": dims.norm_eps,
        "rope_theta": dims.rope_base,
    }


def _dimension_blocks() -> dict[str, object]:
    vision = asdict(TINY.vision)
    return {
        "vlm_config": {
            "model_type": "paligemma",
            "projection_dim": TINY.prefix.width,
            "text_config": _gemma_block(TINY.prefix),
            "vision_config": {
                "model_type": "siglip_vision_model",
                "hidden_size": vision["width"],
                "num_hidden_layers": vision["depth"],
                "intermediate_size": vision["mlp"],
                "num_attention_heads": vision["heads"],
                "patch_size": vision["patch"],
                "image_size": vision["image"],
                "hidden_act": _ACTIVATION,
                "layer_norm_eps": vision["norm_eps"],
            },
        },
        "dit_config": _gemma_block(TINY.expert),
    }


def _write_lerobot(directory: Path, variant: Variant, blocks: tuple[Block, Block]) -> None:
    side = TINY.vision.image
    state, actions = blocks
    mode = "MEAN_STD" if variant == "pi0" else "QUANTILES"
    norms = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    inputs: dict[str, object] = {
        f"observation.images.{slot}": {"type": "VISUAL", "shape": [3, side, side]}
        for slot in OPENPI_SLOTS
    }
    inputs["observation.state"] = {"type": "STATE", "shape": [len(state["mean"])]}
    action = {"action": {"type": "ACTION", "shape": [len(actions["mean"])]}}
    config = {
        "type": variant,
        "input_features": inputs,
        "output_features": action,
        "normalization_mapping": norms,
        "chunk_size": TINY.chunk,
        "n_action_steps": TINY.chunk,
        "max_state_dim": TINY.state,
        "max_action_dim": TINY.action,
        "num_inference_steps": 10,
        "image_resolution": [side, side],
        "empty_cameras": 0,
        "tokenizer_max_length": 48 if variant == "pi0" else 200,
        **_dimension_blocks(),
    }
    if variant == "pi0_fast":
        config |= {"max_decoding_steps": 96, "fast_skip_tokens": TINY_SKIP_TOKENS}
    _write_json(directory / "config.json", config)
    statistics = {"observation.state": state, "action": actions}
    tensors = {
        f"{feature}.{name}": torch.tensor(values)
        for feature, block in statistics.items()
        for name, values in block.items()
    }
    for stage, registry_name, position in (("pre", "normalizer", 5), ("post", "unnormalizer", 0)):
        file = f"policy_{stage}processor_step_{position}_{registry_name}_processor.safetensors"
        save_file(tensors, directory / file)
        step = {
            "registry_name": f"{registry_name}_processor",
            "config": {"eps": 1e-8, "features": inputs | action, "norm_map": norms},
            "state_file": file,
        }
        document = {"name": f"policy_{stage}processor", "steps": [step]}
        _write_json(directory / f"policy_{stage}processor.json", document)


def _write_openpi(directory: Path, blocks: tuple[Block, Block]) -> None:
    # openpi's config.json does not contain the variant; the names of the tensors show it.
    config = {
        "action_dim": TINY.action,
        "action_horizon": TINY.chunk,
        "paligemma_variant": "tiny",
        "action_expert_variant": "tiny",
        "precision": "bfloat16",
        **_dimension_blocks(),
    }
    _write_json(directory / "config.json", config)
    statistics = {"norm_stats": {"state": blocks[0], "actions": blocks[1]}}
    _write_json(directory / "assets" / "tiny" / "norm_stats.json", statistics)
