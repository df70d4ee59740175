"""Model dimensions from a checkpoint's config.json."""

from __future__ import annotations

from pathlib import Path

from rn_backend_pi0.architecture import (
    GEMMA_VARIANTS,
    PALIGEMMA_VOCABULARY,
    SO400M,
    GemmaDims,
    Pi0Dims,
    VisionDims,
)
from rn_backend_pi0.documents import Document, take_integer, take_number, take_object
from roboneuron.errors import CheckpointError

_ACTIVATION = "gelu_pytorch_tanh"


def read_dims(config: Document, path: Path, *, chunk: int, state: int, action: int) -> Pi0Dims:
    """Model dimensions: from the blocks vlm_config and dit_config when there, else by the names of the variants.

    Raises:
        CheckpointError: an unknown variant, or a block this network cannot follow.
    """
    if "vlm_config" in config or "dit_config" in config:
        vlm = take_object(config, "vlm_config", path)
        text = take_object(vlm, "text_config", path)
        vision, vocabulary = (
            _vision(take_object(vlm, "vision_config", path), path),
            take_integer(text, "vocab_size", path),
        )
        prefix, expert = _gemma(text, path), _gemma(take_object(config, "dit_config", path), path)
    else:
        vision, vocabulary = SO400M, PALIGEMMA_VOCABULARY
        prefix = _variant(config, "paligemma_variant", path)
        expert = _variant(config, "action_expert_variant", path)
    return Pi0Dims(
        vision=vision,
        prefix=prefix,
        expert=expert,
        vocabulary=vocabulary,
        chunk=chunk,
        state=state,
        action=action,
        min_period=take_number(config, "min_period", path, 4e-3),
        max_period=take_number(config, "max_period", path, 4.0),
    )


def _variant(config: Document, key: str, path: Path) -> GemmaDims:
    name = config.get(key)
    if not isinstance(name, str) or name not in GEMMA_VARIANTS:
        hint = (
            "Merge the LoRA weights first."
            if str(name).endswith("_lora")
            else "Own sizes go into vlm_config/dit_config."
        )
        raise CheckpointError(f"{path}: {key!r} is {name!r}, expected one of {', '.join(GEMMA_VARIANTS)}.", hint=hint)
    return GEMMA_VARIANTS[name]


def _check_activation(block: Document, keys: tuple[str, ...], path: Path) -> None:
    for key in keys:
        if block.get(key, _ACTIVATION) != _ACTIVATION:
            raise CheckpointError(f"{path}: {key!r} is {block[key]!r}, pi0 uses {_ACTIVATION!r}.")


def _vision(block: Document, path: Path) -> VisionDims:
    _check_activation(block, ("hidden_act",), path)
    return VisionDims(
        width=take_integer(block, "hidden_size", path),
        depth=take_integer(block, "num_hidden_layers", path),
        mlp=take_integer(block, "intermediate_size", path),
        heads=take_integer(block, "num_attention_heads", path),
        patch=take_integer(block, "patch_size", path, 14),
        image=take_integer(block, "image_size", path, 224),
        norm_eps=take_number(block, "layer_norm_eps", path, 1e-6),
    )


def _gemma(block: Document, path: Path) -> GemmaDims:
    _check_activation(block, ("hidden_activation", "hidden_act"), path)
    return GemmaDims(
        width=take_integer(block, "hidden_size", path),
        depth=take_integer(block, "num_hidden_layers", path),
        mlp=take_integer(block, "intermediate_size", path),
        heads=take_integer(block, "num_attention_heads", path),
        kv_heads=take_integer(block, "num_key_value_heads", path),
        head_dim=take_integer(block, "head_dim", path),
        norm_eps=take_number(block, "rms_norm_eps", path, 1e-6),
        rope_base=take_number(block, "rope_theta", path, 10_000.0),
    )
