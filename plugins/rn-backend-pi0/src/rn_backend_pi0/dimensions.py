"""Model dimensions from a checkpoint's config.json."""

from __future__ import annotations

from pathlib import Path

from rn_backend_pi0.architecture import (
    GEMMA_VARIANTS,
    PALIGEMMA_VOCABULARY,
    SO400M,
    GemmaDims,
    Pi0Dims,
    Variant,
    VisionDims,
)
from rn_backend_pi0.documents import DimensionsDocument, GemmaSettings, VisionSettings
from roboneuron import CheckpointError


def read_dims(
    config: DimensionsDocument,
    path: Path,
    *,
    chunk: int,
    state: int,
    action: int,
    variant: Variant = "pi0",
) -> Pi0Dims:
    """Model dimensions: from the blocks vlm_config and dit_config if present, else from the names
    of the variants.

    Raises:
        CheckpointError: an unknown variant, or blocks that do not fit together.
    """
    if config.vlm_config is not None and config.dit_config is not None:
        text = config.vlm_config.text_config
        vision, vocabulary = _vision(config.vlm_config.vision_config), text.vocab_size or 0
        prefix, expert = _gemma(text), _gemma(config.dit_config)
    else:
        vision, vocabulary = SO400M, PALIGEMMA_VOCABULARY
        prefix = _variant("paligemma_variant", config.paligemma_variant, path)
        expert = _variant("action_expert_variant", config.action_expert_variant, path)
    return Pi0Dims(
        vision=vision,
        prefix=prefix,
        expert=expert,
        vocabulary=vocabulary,
        variant=variant,
        chunk=chunk,
        state=state,
        action=action,
        min_period=config.min_period,
        max_period=config.max_period,
    )


def _variant(key: str, name: str | None, path: Path) -> GemmaDims:
    if name is None or name not in GEMMA_VARIANTS:
        hint = (
            "Merge the LoRA weights first."
            if str(name).endswith("_lora")
            else "Define other sizes in vlm_config/dit_config."
        )
        raise CheckpointError(
            f"{path}: {key!r} is {name!r}, expected one of {', '.join(GEMMA_VARIANTS)}.", hint=hint
        )
    return GEMMA_VARIANTS[name]


def _vision(block: VisionSettings) -> VisionDims:
    return VisionDims(
        width=block.hidden_size,
        depth=block.num_hidden_layers,
        mlp=block.intermediate_size,
        heads=block.num_attention_heads,
        patch=block.patch_size,
        image=block.image_size,
        norm_eps=block.layer_norm_eps,
    )


def _gemma(block: GemmaSettings) -> GemmaDims:
    return GemmaDims(
        width=block.hidden_size,
        depth=block.num_hidden_layers,
        mlp=block.intermediate_size,
        heads=block.num_attention_heads,
        kv_heads=block.num_key_value_heads,
        head_dim=block.head_dim,
        norm_eps=block.rms_norm_eps,
        rope_base=block.rope_theta,
    )
