"""The JSON files of a checkpoint as typed models; keys that inference does not need are ignored."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from rn_backend_openvla.statistics import DatasetStatistics
from roboneuron.errors import CheckpointError

M = TypeVar("M", bound=BaseModel)


class TextConfig(BaseModel):
    """Stored as a difference from transformers' LlamaConfig, hence the defaults (note norm epsilon 1e-6)."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    model_type: str = "llama"
    hidden_size: int = 4096
    intermediate_size: int = 11008
    num_hidden_layers: int = 32
    num_attention_heads: int = 32
    num_key_value_heads: int | None = None
    vocab_size: int = 32000
    rms_norm_eps: float = 1e-6
    rope_theta: float = 10000.0
    rope_scaling: dict[str, Any] | None = None
    max_position_embeddings: int = 2048
    hidden_act: str = "silu"
    attention_bias: bool = False
    mlp_bias: bool = False
    tie_word_embeddings: bool = False


class TinyVision(BaseModel):
    """Sizes of towers that are smaller than the public ones, for tests."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    embed_dim: int
    depth: int
    num_heads: int


class ModelConfig(BaseModel):
    """What is used of config.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    vision_backbone_id: str
    llm_backbone_id: str = ""
    image_resize_strategy: str = "resize-naive"
    pad_to_multiple_of: int = 64
    n_action_bins: int = 256
    text_config: TextConfig = TextConfig()
    norm_stats: dict[str, DatasetStatistics] = {}
    tiny_vision_overrides: TinyVision | None = None


class Normalize(BaseModel):
    """Pixel normalisation of one tower. Trusted over the keys `means` and `stds`, which training did not use."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    mean: tuple[float, float, float]
    std: tuple[float, float, float]


class ProcessorConfig(BaseModel):
    """What is used of preprocessor_config.json."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    tvf_normalize_params: tuple[Normalize, ...]
    tvf_do_letterbox: bool = False


class Index(BaseModel):
    """model.safetensors.index.json: file by tensor."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    weight_map: dict[str, str]


def read_json(path: Path) -> Any:
    """The parsed file. Raises CheckpointError when it is absent or damaged."""
    if not path.is_file():
        raise CheckpointError(f"{path} does not exist.", hint="Check that the checkpoint is complete.")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise CheckpointError(f"{path} is not readable JSON: {error}") from error


def read_model(path: Path, model: type[M]) -> M:
    """The parsed and checked file. Raises CheckpointError with the first thing that is wrong."""
    raw = read_json(path)
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise CheckpointError(f"{path} does not say what is needed: {first_problem(error)}") from error


def first_problem(error: ValidationError) -> str:
    """Where and what the first problem is."""
    found = error.errors()[0]
    return f"{'.'.join(map(str, found['loc']))}: {found['msg']}"
