"""Sizes, scales and settings of the policy and its training, stored with the weights."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Size = Annotated[int, Field(ge=1)]
ROWS = 5
"""Actions of a chunk, as in `constants = "bridge"` of the backend."""
ACTION_WIDTH = 7
PLACEHOLDERS = ROWS * ACTION_WIDTH
STATE_WIDTH = 7
PATCH_PX, GRID = 14, 16
PATCHES = GRID * GRID
PATCH_VALUES = 3 * PATCH_PX * PATCH_PX
VOCABULARY, PADDING = 32064, 64
MOVE_SCALE_M, TILT_SCALE_RAD, TURN_SCALE_RAD = 0.03, 0.05, 0.20
"""Values of 1.0 in a normalised action: translation, rotation about x and y, rotation about z."""
ACTION_SCALE = (MOVE_SCALE_M,) * 3 + (TILT_SCALE_RAD,) * 2 + (TURN_SCALE_RAD,)
STATE_LOW = (0.25, -0.35, 0.0, -0.3, -0.3, -1.6, 0.0)
STATE_HIGH = (0.70, 0.35, 0.50, 0.3, 0.3, 1.6, 1.0)
"""Range of the state: TCP position [m], roll, pitch, yaw relative to a gripper pointing down [rad],
opening.
"""


class NetworkShape(BaseModel):
    """Sizes of the network."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    vision_width: Size = 64
    """Width of each of the two vision towers."""
    vision_depth: Annotated[int, Field(ge=2)] = 2
    """Blocks of a tower on disk; the last one is never run."""
    vision_heads: Size = 2
    hidden: Size = 96
    """Width of the language model."""
    intermediate: Size = 192
    layers: Annotated[int, Field(ge=2)] = 4
    heads: Size = 3
    rope_theta: float = 1e8
    """Large, so that most dimensions hardly rotate over a few hundred positions, and content is
    found at any position.
    """


class TrainingRecipe(BaseModel):
    """Settings that the trainings of both policies share. Two runs of one recipe over the same
    shards are bit-identical on one machine.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    seed: int = 0
    shards: Annotated[int, Field(ge=2)] = 80
    """Shards of demonstrations; the last `held_out` of them are for measuring."""
    held_out: Size = 1
    steps: Size = 12_000
    """Total number of optimiser steps."""
    cool_down: Annotated[float, Field(ge=0, le=1)] = 0.3
    """Fraction of the steps, at the end, over which the rate falls to zero."""
    warm_up: Size = 100
    rate: float = 2e-3
    views: Size = 32
    """Views per step; each gives one training pair for every colour."""
    tokens: Size = 24
    """Visual tokens of a training step (of 256): those with cubes, and a sample that represents the
    others.
    """
    light: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Fraction of the training views in another light, with noise; see `relit`."""
    full_from: Annotated[float, Field(ge=0, le=1)] = 0.97
    """Fraction of the steps after which all visual tokens are used."""
    full_views: Size = 8
    """Views per step from then on."""


class Recipe(TrainingRecipe):
    """Settings of the training of the policy that answers like OpenVLA-OFT."""

    shape: NetworkShape = NetworkShape()
    continues: bool = False
    """Training starts from earlier weights. The auxiliary heads start untrained, so their losses
    grow to their full weight during the warm-up.
    """
