"""A checkpoint directory in the public layout: contents of its small files, checked before any
weight is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import Field, TypeAdapter

from rn_vla.checkpoint_files import (
    check_schema,
    clip,
    explain_families,
    list_names,
    read_json,
    read_schema,
)
from rn_vla.decoding import DecoderShape, Shard
from rn_vla.openvla.layout import TowerShape, VisionShape, expected_weights
from rn_vla.openvla.model_files import OpenvlaConfig, ProcessorConfig, ShardIndex, TextConfig
from rn_vla.openvla.preprocessing import TowerPixels
from rn_vla.openvla.statistics import DatasetStatistics, Key
from roboneuron import CheckpointError

_DINO = TowerShape(
    width=1024,
    depth=24,
    heads=16,
    intermediate=4096,
    prefix_tokens=5,
    layer_scale=True,
    pooled=False,
)
_SIGLIP = TowerShape(
    width=1152,
    depth=27,
    heads=16,
    intermediate=4304,
    prefix_tokens=0,
    layer_scale=False,
    pooled=True,
)
_MLP_RATIO = MappingProxyType({True: 4.0, False: 3.7362})
"""Intermediate over width of DINOv2 (with layer scale) and SigLIP. Source: timm's definitions of
the two models.
"""
_MAX_INDEX_BYTES = 16 * 2**20
BACKBONES: Mapping[str, tuple[TowerShape, ...]] = MappingProxyType(
    {"dinosiglip-vit-so-224px": (_DINO, _SIGLIP), "siglip-vit-so400m": (_SIGLIP,)}
)
"""Vision towers by the checkpoint's `vision_backbone_id`."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class OpenvlaCheckpoint:
    """Contents of a checkpoint's small files.

    Attributes:
        path: its directory.
        decoder, vision: shapes.
        action_bins: bins per action value.
        token_vocabulary: ids before padding; action tokens are at its end.
        is_vicuna: True for the first release (v01), with another prompt.
        towers: pixel normalisation, one per vision tower.
        statistics: data sets by key.
        statistics_source: the file they come from.
        shards: weight files with the tensors of each.
    """

    path: Path
    decoder: DecoderShape
    vision: VisionShape
    action_bins: int
    token_vocabulary: int
    is_vicuna: bool
    towers: tuple[TowerPixels, ...]
    statistics: Mapping[str, DatasetStatistics]
    statistics_source: str
    shards: tuple[Shard, ...]

    @classmethod
    def read(cls, path: Path) -> OpenvlaCheckpoint:
        """Read config.json, preprocessor_config.json, dataset_statistics.json and the index of the
        weights.

        Raises:
            CheckpointError: a file is missing or damaged, or the checkpoint is of another family.
        """
        if not path.is_dir():
            raise CheckpointError(
                f"Checkpoint {path} is not a directory.",
                hint="Set `checkpoint` to the model's folder.",
            )
        config = _read_config(path)
        decoder = _decoder_shape(config.text_config, path)
        vision = VisionShape(towers=_towers(config, path), hidden=decoder.hidden)
        processor = read_schema(path / "preprocessor_config.json", ProcessorConfig)
        if len(processor.tvf_normalize_params) != len(vision.towers):
            raise CheckpointError(
                f"{path / 'preprocessor_config.json'} normalises for "
                f"{len(processor.tvf_normalize_params)} towers, "
                f"the model has {len(vision.towers)}."
            )
        _check_resizing(path, config, processor)
        statistics, source = _read_statistics(path, config)
        return cls(
            path=path,
            decoder=decoder,
            vision=vision,
            action_bins=config.n_action_bins,
            token_vocabulary=decoder.vocabulary - config.pad_to_multiple_of,
            is_vicuna="vicuna" in config.llm_backbone_id,
            towers=tuple(
                TowerPixels(mean=p.mean, std=p.std) for p in processor.tvf_normalize_params
            ),
            statistics=statistics,
            statistics_source=source,
            shards=_read_shards(path, vision, decoder),
        )


def _check_resizing(path: Path, config: OpenvlaConfig, processor: ProcessorConfig) -> None:
    """Raise CheckpointError if either of the two files requires resizing that keeps the aspect
    ratio.
    """
    for file, strategy in (("config.json", config), ("preprocessor_config.json", processor)):
        if strategy.image_resize_strategy != "resize-naive":
            raise CheckpointError(
                f"{path / file}: image_resize_strategy is {strategy.image_resize_strategy!r}, "
                "only 'resize-naive' is implemented."
            )
    if processor.tvf_do_letterbox:
        raise CheckpointError(
            f"{path / 'preprocessor_config.json'}: tvf_do_letterbox is true; padding images to a "
            "square (letterbox) is "
            "not implemented."
        )


def _read_config(path: Path) -> OpenvlaConfig:
    raw = read_json(path / "config.json")
    family = raw.get("model_type") or raw.get("type") if isinstance(raw, dict) else None
    if family != "openvla":
        raise CheckpointError(
            f"{path} is a checkpoint of the family {clip(repr(family))}, expected 'openvla'.",
            hint=explain_families(family),
        )
    return check_schema(raw, TypeAdapter(OpenvlaConfig), path / "config.json")


def _decoder_shape(text: TextConfig, path: Path) -> DecoderShape:
    supported = {
        "model_type": (text.model_type, "llama"),
        "hidden_act": (text.hidden_act, "silu"),
        "rope_scaling": (text.rope_scaling, None),
        "attention_bias": (text.attention_bias, False),
        "mlp_bias": (text.mlp_bias, False),
        "tie_word_embeddings": (text.tie_word_embeddings, False),
    }
    for name, (got, expected) in supported.items():
        if got != expected:
            raise CheckpointError(
                f"{path / 'config.json'}: text_config.{name} is {clip(repr(got))}, expected "
                f"{expected!r}."
            )
    return DecoderShape(
        hidden=text.hidden_size,
        intermediate=text.intermediate_size,
        layers=text.num_hidden_layers,
        heads=text.num_attention_heads,
        key_value_heads=text.num_key_value_heads or text.num_attention_heads,
        vocabulary=text.vocab_size,
        norm_epsilon=text.rms_norm_eps,
        rope_theta=text.rope_theta,
        max_positions=text.max_position_embeddings,
    )


def _towers(config: OpenvlaConfig, path: Path) -> tuple[TowerShape, ...]:
    towers = BACKBONES.get(config.vision_backbone_id)
    if towers is None:
        raise CheckpointError(
            f"{path / 'config.json'}: vision_backbone_id is {config.vision_backbone_id!r}, "
            f"expected one of {', '.join(BACKBONES)}."
        )
    tiny = config.tiny_vision_overrides
    if tiny is None:
        return towers
    return tuple(
        replace(
            tower,
            width=tiny.embed_dim,
            depth=tiny.depth,
            heads=tiny.num_heads,
            intermediate=int(tiny.embed_dim * _MLP_RATIO[tower.layer_scale]),
        )
        for tower in towers
    )


def _read_statistics(
    path: Path, config: OpenvlaConfig
) -> tuple[Mapping[str, DatasetStatistics], str]:
    """Statistics and their source; the file of a fine-tuned checkpoint replaces those of
    config.json.
    """
    own = path / "dataset_statistics.json"
    if not _is_there(own):
        return config.norm_stats, str(path / "config.json")
    schema = TypeAdapter(Annotated[dict[Key, DatasetStatistics], Field(max_length=1000)])
    return check_schema(read_json(own), schema, own), str(own)


def _is_there(path: Path) -> bool:
    """True if an optional file exists; a broken link counts, so that it causes an error instead of
    being ignored.
    """
    return path.is_symlink() or path.exists()


def _read_shards(path: Path, vision: VisionShape, decoder: DecoderShape) -> tuple[Shard, ...]:
    expected = expected_weights(vision, decoder)
    index = path / "model.safetensors.index.json"
    if not _is_there(index):
        return (Shard(path=path / "model.safetensors", weights=expected),)
    files = read_schema(index, ShardIndex, _MAX_INDEX_BYTES).weight_map
    missing, extra = sorted(expected.keys() - files.keys()), sorted(files.keys() - expected.keys())
    if missing or extra:
        raise CheckpointError(
            f"{index} does not list the weights of this model: {len(missing)} missing "
            f"({list_names(missing)}), "
            f"{len(extra)} unexpected ({list_names(extra)}).",
            hint="Check that the checkpoint belongs to this backend and is complete.",
        )
    outside = sorted({name for name in files.values() if Path(name).name != name})
    if outside:
        raise CheckpointError(f"{index} names files outside its directory: {list_names(outside)}.")
    return tuple(
        Shard(
            path=path / file,
            weights={name: expected[name] for name in files if files[name] == file},
        )
        for file in sorted(set(files.values()))
    )
