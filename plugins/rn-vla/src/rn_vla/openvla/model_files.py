"""The JSON files of a checkpoint as typed models with bounds; keys that inference does not need are
ignored.

The bounds leave ample margin for every model of the family. They prevent a damaged number from
costing memory or time before it is compared with the tensors.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.openvla.statistics import DatasetStatistics, Key

Name = Annotated[str, Field(max_length=200)]
Width = Annotated[int, Field(ge=1, le=65_536, strict=True)]
Count = Annotated[int, Field(ge=1, le=512, strict=True)]
Image = Literal[224]
Level = Annotated[float, Field(ge=0, le=1)]
Spread = Annotated[float, Field(ge=1e-3, le=1)]


class TextConfig(BaseModel):
    """Stored as a difference from transformers' LlamaConfig, hence the defaults (note norm epsilon
    1e-6).
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    model_type: Name = "llama"
    hidden_size: Width = 4096
    intermediate_size: Annotated[int, Field(ge=1, le=262_144, strict=True)] = 11008
    num_hidden_layers: Count = 32
    num_attention_heads: Count = 32
    num_key_value_heads: Count | None = None
    vocab_size: Annotated[int, Field(ge=1, le=1_000_000, strict=True)] = 32000
    rms_norm_eps: Annotated[float, Field(ge=1e-12, le=0.01)] = 1e-6
    rope_theta: Annotated[float, Field(ge=100, le=1e8)] = 10000.0
    rope_scaling: dict[Name, object] | None = None
    max_position_embeddings: Annotated[int, Field(ge=1, le=32_768, strict=True)] = 2048
    hidden_act: Name = "silu"
    attention_bias: bool = False
    mlp_bias: bool = False
    tie_word_embeddings: bool = False

    @model_validator(mode="after")
    def _check_heads(self) -> TextConfig:
        heads, groups = (
            self.num_attention_heads,
            self.num_key_value_heads or self.num_attention_heads,
        )
        if self.hidden_size % heads or (self.hidden_size // heads) % 2 or heads % groups:
            raise ValueError(
                f"hidden_size {self.hidden_size}, num_attention_heads {heads} and "
                f"num_key_value_heads {groups} do not "
                "divide into heads of an even width"
            )
        return self


class TinyVision(BaseModel):
    """Sizes of towers that are smaller than the public ones, for tests."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    embed_dim: Annotated[int, Field(ge=2, le=4096, strict=True)]
    depth: Annotated[int, Field(ge=2, le=128, strict=True)]
    num_heads: Annotated[int, Field(ge=1, le=128, strict=True)]

    @model_validator(mode="after")
    def _check_heads(self) -> TinyVision:
        if self.embed_dim % self.num_heads:
            raise ValueError(
                f"embed_dim {self.embed_dim} is no multiple of num_heads {self.num_heads}"
            )
        return self


class OpenvlaConfig(BaseModel):
    """The keys used of config.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    vision_backbone_id: Name
    llm_backbone_id: Name = ""
    image_resize_strategy: Name = "resize-naive"
    image_sizes: Annotated[tuple[Image, ...], Field(max_length=2)] | None = None
    pad_to_multiple_of: Annotated[int, Field(ge=1, le=4096, strict=True)] = 64
    n_action_bins: Annotated[int, Field(ge=2, le=4096, strict=True)] = 256
    text_config: TextConfig = TextConfig()
    norm_stats: Annotated[dict[Key, DatasetStatistics], Field(max_length=1000)] = {}
    tiny_vision_overrides: TinyVision | None = None

    @model_validator(mode="after")
    def _check_vocabulary(self) -> OpenvlaConfig:
        if self.text_config.vocab_size - self.pad_to_multiple_of <= self.n_action_bins:
            raise ValueError(
                f"text_config.vocab_size {self.text_config.vocab_size} less pad_to_multiple_of "
                f"{self.pad_to_multiple_of} leaves no place for n_action_bins {self.n_action_bins}"
            )
        return self


class Normalize(BaseModel):
    """Pixel normalisation of one tower, on values from 0 to 1.

    Takes precedence over the keys `means` and `stds`, which training did not use.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    mean: tuple[Level, Level, Level]
    std: tuple[Spread, Spread, Spread]


class ProcessorConfig(BaseModel):
    """The keys used of preprocessor_config.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    tvf_normalize_params: Annotated[tuple[Normalize, ...], Field(min_length=1, max_length=2)]
    tvf_do_letterbox: bool = False
    image_resize_strategy: Name = "resize-naive"
    input_sizes: (
        Annotated[tuple[tuple[Literal[3], Image, Image], ...], Field(max_length=2)] | None
    ) = None
    interpolations: Annotated[tuple[Literal["bicubic"], ...], Field(max_length=2)] | None = None


class ShardIndex(BaseModel):
    """model.safetensors.index.json: file by tensor."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    weight_map: Annotated[
        dict[
            Annotated[str, Field(max_length=400)],
            Annotated[str, Field(max_length=255, pattern=r"^[^\x00-\x1f]+\.safetensors$")],
        ],
        Field(max_length=50_000),
    ]
