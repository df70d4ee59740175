"""Sizes, scales and settings of the flow policy and its training, stored with its weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from rn_policy_cubes.recipe import STATE_HIGH, STATE_LOW, Size, TrainingRecipe

FLOW_ROWS = 10
"""Actions of a chunk: one second, so that rows are left to continue when the next one begins."""
ACTION_MEAN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.8)
ACTION_STD = (0.015, 0.015, 0.015, 0.01, 0.01, 0.08, 0.4)
"""Statistics that normalise actions: translation [m], rotation vector [rad], opening. Rounded from
those of the teacher's chunks.
"""
STATE_MEAN = tuple(
    round((low + high) / 2, 6) for low, high in zip(STATE_LOW, STATE_HIGH, strict=True)
)
STATE_STD = tuple(
    round((high - low) / 2, 6) for low, high in zip(STATE_LOW, STATE_HIGH, strict=True)
)
"""Statistics that map the range of the state to -1 .. 1."""


class FlowShape(BaseModel):
    """Sizes of the flow network."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    vision_width: Size = 128
    vision_depth: Size = 2
    vision_heads: Size = 4
    vision_inner: Size = 256
    hidden: Size = 96
    """Width of the language model."""
    intermediate: Size = 192
    expert: Annotated[int, Field(ge=2, multiple_of=2)] = 96
    """Width of the action expert."""
    expert_intermediate: Size = 192
    layers: Annotated[int, Field(ge=3)] = 5
    """Layers of the language model and of the expert; the former's last one is only keys and
    values.
    """
    heads: Size = 3
    head_width: Annotated[int, Field(ge=2, multiple_of=2)] = 32
    rope_theta: float = 1e8
    """Large, so that content is found at any position, as in the other policy."""
    min_period: float = 0.1
    max_period: float = 4.0
    """Range of the embedding of the flow time. The shortest period of pi0, 0.004, is noise to a
    small network.
    """


class FlowRecipe(TrainingRecipe):
    """Settings of the training of the flow policy."""

    shape: FlowShape = FlowShape()
    shards: Annotated[int, Field(ge=2)] = 30
    """Shards of demonstrations; the last `held_out` of them are for measuring."""
    samples: Size = 3
    """Flow times and noises per pair; the prefix is computed once for all of them."""
