"""The JSON files of a checkpoint as typed models with bounds; keys that inference does not need are
ignored.

The bounds leave ample margin for every released pi0. They prevent a damaged number from costing
memory or time before it is compared with the tensors.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Name = Annotated[str, Field(max_length=200)]
FileName = Annotated[str, Field(min_length=1, max_length=255, pattern=r"^[^/\\\x00-\x1f]+$")]
Width = Annotated[int, Field(ge=1, le=65_536, strict=True)]
Inner = Annotated[int, Field(ge=1, le=262_144, strict=True)]
Count = Annotated[int, Field(ge=1, le=256, strict=True)]
Epsilon = Annotated[float, Field(ge=1e-12, le=0.01)]
Activation = Literal["gelu_pytorch_tanh"]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class GemmaSettings(_Document):
    """One of vlm_config.text_config and dit_config."""

    hidden_size: Width
    num_hidden_layers: Count
    intermediate_size: Inner
    num_attention_heads: Count
    num_key_value_heads: Count
    head_dim: Annotated[int, Field(ge=2, le=1024, multiple_of=2, strict=True)]
    vocab_size: Annotated[int, Field(ge=1, le=1_000_000, strict=True)] | None = None
    rms_norm_eps: Epsilon = 1e-6
    rope_theta: Annotated[float, Field(ge=100, le=1e8)] = 10_000.0
    hidden_activation: Activation | None = None
    hidden_act: Activation | None = None


class VisionSettings(_Document):
    """vlm_config.vision_config."""

    hidden_size: Width
    num_hidden_layers: Count
    intermediate_size: Inner
    num_attention_heads: Count
    patch_size: Annotated[int, Field(ge=2, le=128, strict=True)] = 14
    image_size: Annotated[int, Field(ge=16, le=1024, strict=True)] = 224
    layer_norm_eps: Epsilon = 1e-6
    hidden_act: Activation | None = None

    @model_validator(mode="after")
    def _heads_divide(self) -> Self:
        if self.hidden_size % self.num_attention_heads:
            raise ValueError(
                f"hidden_size {self.hidden_size} is no multiple of {self.num_attention_heads} heads"
            )
        return self


class VlmBlock(_Document):
    """vlm_config: the language model and its vision tower."""

    text_config: GemmaSettings
    vision_config: VisionSettings

    @model_validator(mode="after")
    def _vocabulary_is_there(self) -> Self:
        if self.text_config.vocab_size is None:
            raise ValueError("text_config has no vocab_size")
        return self


class DimensionsDocument(_Document):
    """Settings of the network's size in both layouts: blocks, or names of variants."""

    vlm_config: VlmBlock | None = None
    dit_config: GemmaSettings | None = None
    paligemma_variant: Name | None = None
    action_expert_variant: Name | None = None
    min_period: Annotated[float, Field(ge=1e-6, le=1e3)] = 4e-3
    max_period: Annotated[float, Field(ge=1e-6, le=1e3)] = 4.0

    @model_validator(mode="after")
    def _blocks_are_complete(self) -> Self:
        if (self.vlm_config is None) != (self.dit_config is None):
            raise ValueError("vlm_config and dit_config must be given together")
        if self.min_period >= self.max_period:
            raise ValueError(
                f"min_period {self.min_period} is not below max_period {self.max_period}"
            )
        return self


Chunk = Annotated[int, Field(ge=1, le=1024, strict=True)]
Padded = Annotated[int, Field(ge=1, le=1024, strict=True)]
PromptLength = Annotated[int, Field(ge=4, le=1024, strict=True)]


class PolicyFeature(_Document):
    """One entry of input_features."""

    type: Name
    shape: Annotated[
        tuple[Annotated[int, Field(ge=1, le=65_536, strict=True)], ...], Field(max_length=8)
    ] = ()


class LerobotConfig(DimensionsDocument):
    """config.json of a LeRobot checkpoint."""

    normalization_mapping: Annotated[dict[Name, Name], Field(max_length=16)]
    input_features: Annotated[dict[Name, PolicyFeature], Field(max_length=64)]
    empty_cameras: Annotated[int, Field(ge=0, le=8, strict=True)] = 0
    chunk_size: Chunk = 50
    n_action_steps: Chunk | None = None
    max_state_dim: Padded = 32
    max_action_dim: Padded = 32
    num_inference_steps: Annotated[int, Field(ge=1, le=1000, strict=True)] = 10
    tokenizer_max_length: PromptLength | None = None
    output_features: Annotated[dict[Name, PolicyFeature], Field(max_length=64)] = {}
    temperature: Annotated[float, Field(ge=0, le=100)] = 0.0
    max_decoding_steps: Annotated[int, Field(ge=1, le=2048, strict=True)] = 256
    fast_skip_tokens: Annotated[int, Field(ge=0, le=100_000, strict=True)] = 128
    use_visual_memory: bool = False
    use_proprioceptive_memory: bool = False
    image_resolution: tuple[int, int] | None = None
    rtc_training_max_delay: Annotated[int, Field(ge=0, le=1000, strict=True)] | None = None


class OpenpiConfig(DimensionsDocument):
    """config.json of an openpi PyTorch checkpoint."""

    action_dim: Padded
    action_horizon: Chunk
    max_token_len: PromptLength | None = None


class ProcessorStep(_Document):
    """One step of policy_preprocessor.json or policy_postprocessor.json."""

    registry_name: Name
    config: dict[Name, object] = {}
    state_file: FileName | None = None


class StepConfig(_Document):
    """The keys used of a step's config."""

    eps: Annotated[float, Field(ge=1e-12, le=0.1)] = 1e-8
    enabled: bool = False
    exclude_joints: Annotated[tuple[Name, ...], Field(max_length=64)] | None = ("gripper",)
    include_state_in_prompt: bool = True


class ProcessorDocument(_Document):
    """policy_preprocessor.json or policy_postprocessor.json."""

    steps: Annotated[tuple[ProcessorStep, ...], Field(max_length=64)]


class FastProcessor(_Document):
    """processor_config.json of an action tokenizer."""

    scale: Annotated[float, Field(gt=0, le=1e6)] = 10.0
    vocab_size: Annotated[int, Field(ge=1, le=1_000_000, strict=True)] = 1024
    min_token: Annotated[int, Field(ge=-1_000_000, le=1_000_000, strict=True)] = 0
    time_horizon: Chunk | None = None
    action_dim: Padded | None = None


class ProfileDocument(_Document):
    """roboneuron.json next to config.json."""

    profile: Name = ""


class Pi0ShardIndex(_Document):
    """model.safetensors.index.json: file by tensor."""

    weight_map: Annotated[
        dict[Annotated[str, Field(max_length=400)], FileName],
        Field(min_length=1, max_length=50_000),
    ]
