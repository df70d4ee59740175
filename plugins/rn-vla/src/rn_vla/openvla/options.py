"""Options common to all backends of OpenVLA checkpoints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.openvla.preprocessing import ImageStep
from rn_vla.openvla.profiles import PROFILES, ActionProfile, GripperSign, RotationUnit
from roboneuron import AgentMaySet, ConfigurationOnly

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class OwnProfile(BaseModel):
    """Meaning of a checkpoint's actions, given field by field: `profile = "own"`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    metres_per_unit: Positive
    """Metres per unit of the first three un-normalised values."""
    radians_per_unit: Positive
    """Radians per unit of the next three values."""
    rotation: RotationUnit
    """`rotvec`, or `rpy` (roll, pitch, yaw about fixed axes)."""
    frame: Literal["base", "tcp"] = "base"
    """Axes of the deltas."""
    gripper: GripperSign
    """Meaning of the last value."""
    gripper_threshold: bool = True
    """Round the opening to fully open or fully closed at the middle."""
    clip_units: bool = False
    """Clip the first six values to -1 .. 1 before scaling, as the training environment did."""
    step_s: Positive
    """Time between two actions of the training data [s]."""


class OpenVlaModelOptions(BaseModel):
    """Options of every backend of the family."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    checkpoint: Annotated[Path, ConfigurationOnly()]
    """Directory with config.json, the weights, the processor and the tokenizer."""
    unnorm_key: Annotated[str | None, AgentMaySet()] = None
    """Data set whose statistics un-normalise the model's values; optional if there is only one."""
    profile: Literal["libero", "bridge", "own"]
    """Meaning, units and frame of the actions; never guessed."""
    own_profile: OwnProfile | None = None
    """The fields of `profile = "own"`."""
    image_steps: tuple[ImageStep, ...] = ()
    """Steps that the training pipeline applied to camera images before the processor, in order."""
    max_prompt_tokens: Annotated[int, Field(ge=16, le=1024)] = 128
    """Longest prompt in tokens; memory for its keys and values is reserved."""
    timeout_s: Positive | None = None
    """Time after which an inference is aborted; None for no limit."""

    max_outside_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.15
    """Largest accepted fraction of decoded tokens that are not action tokens (they count as
    full-scale moves).
    """

    @model_validator(mode="after")
    def _check_profile(self) -> OpenVlaModelOptions:
        if (self.profile == "own") != (self.own_profile is not None):
            raise ValueError('own_profile must be given exactly when profile is "own"')
        return self

    def action_profile(self) -> ActionProfile:
        """The chosen profile with all fields."""
        if self.own_profile is None:
            return PROFILES[self.profile]
        return ActionProfile(**self.own_profile.model_dump())
