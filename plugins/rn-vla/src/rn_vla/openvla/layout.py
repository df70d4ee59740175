"""Tensors of a public OpenVLA checkpoint with their shapes, and which of them inference uses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rn_vla.decoding import DecoderShape, Weight

_NOT_COMPUTED = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class TowerShape:
    """One vision transformer.

    Attributes:
        width, depth, heads, intermediate: dimensions of its blocks on disk; the last block is never
            run.
        prefix_tokens: class and register tokens before the patches.
        layer_scale: True if blocks scale their branches.
        pooled: True if the file also holds an attention-pooling head.
        patch, image: side of a patch and of the image [px].
    """

    width: int
    depth: int
    heads: int
    intermediate: int
    prefix_tokens: int
    layer_scale: bool
    pooled: bool
    patch: int = 14
    image: int = 224

    @property
    def patches(self) -> int:
        """Patches per image."""
        return (self.image // self.patch) ** 2


@dataclass(frozen=True, kw_only=True, slots=True)
class VisionShape:
    """The vision part: towers in the order of their pixel channels, and the projector's width.

    Attributes:
        towers: DINOv2 then SigLIP, or SigLIP alone.
        hidden: width of the language model.
    """

    towers: tuple[TowerShape, ...]
    hidden: int

    @property
    def features(self) -> int:
        """Width of the concatenated features."""
        return sum(tower.width for tower in self.towers)

    @property
    def projector(self) -> tuple[int, ...]:
        """Widths from the features to the language model; two towers have one more layer."""
        if len(self.towers) == 1:
            return (self.features, self.hidden, self.hidden)
        return (self.features, 4 * self.features, self.hidden, self.hidden)


TOWER_NAMES = ("featurizer", "fused_featurizer")
"""Names of the towers on disk and in the front module."""


def expected_weights(vision: VisionShape, decoder: DecoderShape) -> Mapping[str, Weight]:
    """Every tensor of the checkpoint by its name on disk."""
    weights: dict[str, Weight] = {}
    for name, tower in zip(TOWER_NAMES, vision.towers, strict=False):
        weights |= _tower_weights(f"vision_backbone.{name}.", f"front.{name}.", tower)
    for index, (before, after) in enumerate(
        zip(vision.projector, vision.projector[1:], strict=False), start=1
    ):
        _add_linear(weights, f"projector.fc{index}", f"front.projector.fc{index}", after, before)
    for name, shape in _decoder_tensors(decoder).items():
        weights[f"language_model.{name}"] = Weight(shape=shape, target=f"decoder.{name}")
    return weights


def _add(weights: dict[str, Weight], name: str, target: str, *shape: int) -> None:
    weights[name] = Weight(shape=shape, target=target)


def _add_linear(
    weights: dict[str, Weight], name: str, target: str, rows: int, columns: int
) -> None:
    _add(weights, f"{name}.weight", target and f"{target}.weight", rows, columns)
    _add(weights, f"{name}.bias", target and f"{target}.bias", rows)


def _add_norm(weights: dict[str, Weight], name: str, target: str, width: int) -> None:
    _add(weights, f"{name}.weight", target and f"{target}.weight", width)
    _add(weights, f"{name}.bias", target and f"{target}.bias", width)


def _tower_weights(disk: str, front: str, tower: TowerShape) -> Mapping[str, Weight]:
    weights: dict[str, Weight] = {}
    width = tower.width
    if tower.prefix_tokens:
        _add(weights, f"{disk}cls_token", f"{front}cls_token", 1, 1, width)
        _add(weights, f"{disk}reg_token", f"{front}reg_token", 1, tower.prefix_tokens - 1, width)
    _add(weights, f"{disk}pos_embed", f"{front}pos_embed", 1, tower.patches, width)
    _add(
        weights,
        f"{disk}patch_embed.proj.weight",
        f"{front}patch_embed.proj.weight",
        width,
        3,
        tower.patch,
        tower.patch,
    )
    _add(weights, f"{disk}patch_embed.proj.bias", f"{front}patch_embed.proj.bias", width)
    for index in range(tower.depth):
        computed = index < tower.depth - 1
        _add_block(
            weights, f"{disk}blocks.{index}.", f"{front}blocks.{index}." if computed else "", tower
        )
    _add_norm(weights, f"{disk}norm", _NOT_COMPUTED, width)
    if tower.pooled:
        pool = f"{disk}attn_pool."
        _add(weights, f"{pool}latent", _NOT_COMPUTED, 1, 1, width)
        _add_linear(weights, f"{pool}q", _NOT_COMPUTED, width, width)
        _add_linear(weights, f"{pool}kv", _NOT_COMPUTED, 2 * width, width)
        _add_linear(weights, f"{pool}proj", _NOT_COMPUTED, width, width)
        _add_norm(weights, f"{pool}norm", _NOT_COMPUTED, width)
        _add_linear(weights, f"{pool}mlp.fc1", _NOT_COMPUTED, tower.intermediate, width)
        _add_linear(weights, f"{pool}mlp.fc2", _NOT_COMPUTED, width, tower.intermediate)
    return weights


def _add_block(weights: dict[str, Weight], disk: str, front: str, tower: TowerShape) -> None:
    width, inner = tower.width, tower.intermediate

    def target(name: str) -> str:
        return front and f"{front}{name}"

    _add_norm(weights, f"{disk}norm1", target("norm1"), width)
    _add_linear(weights, f"{disk}attn.qkv", target("attn.qkv"), 3 * width, width)
    _add_linear(weights, f"{disk}attn.proj", target("attn.proj"), width, width)
    _add_norm(weights, f"{disk}norm2", target("norm2"), width)
    _add_linear(weights, f"{disk}mlp.fc1", target("mlp.fc1"), inner, width)
    _add_linear(weights, f"{disk}mlp.fc2", target("mlp.fc2"), width, inner)
    if tower.layer_scale:
        _add(weights, f"{disk}ls1.scale_factor", target("ls1.scale_factor"), width)
        _add(weights, f"{disk}ls2.scale_factor", target("ls2.scale_factor"), width)


def _decoder_tensors(decoder: DecoderShape) -> Mapping[str, tuple[int, ...]]:
    hidden, inner = decoder.hidden, decoder.intermediate
    wide, narrow = decoder.heads * decoder.head_width, decoder.key_value_heads * decoder.head_width
    tensors: dict[str, tuple[int, ...]] = {
        "model.embed_tokens.weight": (decoder.vocabulary, hidden),
        "model.norm.weight": (hidden,),
        "lm_head.weight": (decoder.vocabulary, hidden),
    }
    for index in range(decoder.layers):
        base = f"model.layers.{index}."
        tensors |= {
            f"{base}self_attn.q_proj.weight": (wide, hidden),
            f"{base}self_attn.k_proj.weight": (narrow, hidden),
            f"{base}self_attn.v_proj.weight": (narrow, hidden),
            f"{base}self_attn.o_proj.weight": (hidden, wide),
            f"{base}mlp.gate_proj.weight": (inner, hidden),
            f"{base}mlp.up_proj.weight": (inner, hidden),
            f"{base}mlp.down_proj.weight": (hidden, inner),
            f"{base}input_layernorm.weight": (hidden,),
            f"{base}post_attention_layernorm.weight": (hidden,),
        }
    return tensors
