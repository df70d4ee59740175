"""Options that every backend of OpenVLA checkpoints has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.openvla.preprocessing import ImageStep
from rn_vla.openvla.profiles import PROFILES, ActionProfile, GripperSign, RotationUnit
from roboneuron import AgentMaySet, ConfigurationOnly

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class OwnProfile(BaseModel):
    """What a checkpoint's actions mean, said field by field: `profile = "own"`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    metres_per_unit: Positive
    """What 1.0 in the first three values means, after un-normalisation."""
    radians_per_unit: Positive
    """What 1.0 in the next three values means."""
    rotation: RotationUnit
    """`rotvec`, or `rpy` (roll, pitch, yaw about fixed axes)."""
    frame: Literal["base", "tcp"] = "base"
    """Axes the deltas are expressed in."""
    gripper: GripperSign
    """What the last value says and which end is open."""
    gripper_threshold: bool = True
    """Round the opening to fully open or fully closed at the middle."""
    clip_units: bool = False
    """Clip the first six values to -1 .. 1 before scaling, as the training environment did."""
    step_s: Positive
    """Time between two actions of the training data [s]."""


class OpenVlaModelOptions(BaseModel):
    """What every backend of the family is told."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    checkpoint: Annotated[Path, ConfigurationOnly()]
    """Directory with config.json, the weights, the processor and the tokenizer."""
    unnorm_key: Annotated[str | None, AgentMaySet()] = None
    """Data set whose statistics turn model values into actions; may be left out when there is only
    one.
    """
    profile: Literal["libero", "bridge", "own"]
    """What the actions mean, in which units and frame; never guessed."""
    own_profile: OwnProfile | None = None
    """The fields of `profile = "own"`."""
    image_steps: tuple[ImageStep, ...] = ()
    """What the training pipeline did to camera images before the processor, in order."""
    max_prompt_tokens: Annotated[int, Field(ge=16, le=1024)] = 128
    """Longest prompt; memory for its keys and values is set aside."""
    timeout_s: Positive | None = None
    """An inference that takes longer is given up; None waits."""

    max_outside_share: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.15
    """Share of decoded tokens that may be no action tokens (they count as full-scale moves); more
    is refused.
    """

    @model_validator(mode="after")
    def _check_profile(self) -> OpenVlaModelOptions:
        if (self.profile == "own") != (self.own_profile is not None):
            raise ValueError('own_profile must be given exactly when profile is "own"')
        return self

    def action_profile(self) -> ActionProfile:
        """The chosen profile, whole."""
        if self.own_profile is None:
            return PROFILES[self.profile]
        return ActionProfile(**self.own_profile.model_dump())
