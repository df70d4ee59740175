"""Options of the OpenVLA-OFT backends."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_backend_oft.constants import CONSTANTS, Constants, StateLayout
from rn_backend_oft.plugin import MAX_CHUNK
from rn_vla.joint_rows import JointGripper, PlatformJoints
from rn_vla.openvla.options import OpenVlaModelOptions
from rn_vla.openvla.statistics import Bounds
from roboneuron import ConfigurationError

Finite = Annotated[float, Field(allow_inf_nan=False)]


class OwnConstants(BaseModel):
    """Constants of another platform, given field by field: `constants = "own"`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    chunk: Annotated[int, Field(ge=1, le=MAX_CHUNK)]
    """Actions per pass of the head."""
    action_width: Annotated[int, Field(ge=1)] = 7
    """Values per action."""
    state: StateLayout
    """Layout of proprioception."""
    bounds: Bounds
    """`q99` for the 1st and 99th percentile, `minmax` for the extremes."""
    gripper: JointGripper = "open_fraction"
    """With `state = "joints"`: 0 closed .. 1 open, or `closed_fraction` 0 open .. 1 closed."""
    step_s: Annotated[float, Field(gt=0, le=10, allow_inf_nan=False)] | None = None
    """With `state = "joints"`: time between two actions of the training data [s]."""

    @model_validator(mode="after")
    def _joints_have_a_step(self) -> OwnConstants:
        if (self.state == "joints") != (self.step_s is not None):
            raise ValueError('step_s must be given exactly when state is "joints"')
        return self

    def constants(self) -> Constants:
        """The same values as `Constants`."""
        return Constants(**self.model_dump(exclude_none=True))


class OftConfig(OpenVlaModelOptions):
    """Options of the OpenVLA-OFT backends."""

    constants: Literal["libero", "bridge", "aloha", "own"]
    """Platform whose chunk length, widths and normalisation the checkpoint was trained with."""
    own_constants: OwnConstants | None = None
    """The fields of `constants = "own"`."""
    profile: Literal["libero", "bridge", "own", "joints"]  # type: ignore[assignment]
    """Meaning, units and frame of the actions; never guessed. `joints` for platforms with joint
    actions, whose constants define it.
    """
    joints: Annotated[tuple[str, ...], Field(max_length=64)] | None = None
    """Robot joint names of the policy's joints, in the policy's order (each arm from the base to
    the tip), for platforms with joint actions; joints are never mapped by position.
    """
    head: Literal["l1", "tokens"] = "l1"
    """`l1` reads action_head--*_checkpoint.pt; `tokens` is for checkpoints without a head, which
    decode bins.
    """
    proprio: bool
    """The checkpoint has a proprio projector and was trained with proprioception."""
    execute: Annotated[int, Field(ge=1, le=MAX_CHUNK)] | None = None
    """Actions of each chunk to execute before the next inference; None executes all."""
    finger_travel_m: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 0.04
    """Travel of each finger joint when open, for the state layout of LIBERO (Panda hand: 0.04)."""
    state_rotation: Literal["by_down", "quaternion"] = "by_down"
    """Choice between the two rotation vectors of a rotation for the state: the one near a gripper
    that points down, or the one that follows the sign of the measured quaternion, as in the
    simulator of the training data.
    """
    finger_joints: tuple[str, str] | None = None
    """Names of both finger joints if the state's last two values are to be their measured
    positions; None derives them from the opening.
    """
    state_origin_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Position of the robot's base in the world frame of the training data; added to the TCP
    position.
    """

    @model_validator(mode="after")
    def _check_constants(self) -> OftConfig:
        if (self.constants == "own") != (self.own_constants is not None):
            raise ValueError('own_constants must be given exactly when constants is "own"')
        chunk = self.platform().chunk
        if self.execute is not None and self.execute > chunk:
            raise ValueError(f"execute is {self.execute}, but a chunk holds {chunk} actions")
        return self

    def platform(self) -> Constants:
        """The chosen constants with all fields."""
        if self.own_constants is None:
            return CONSTANTS[self.constants]
        return self.own_constants.constants()

    def joint_rows(self) -> PlatformJoints | None:
        """The rows of a platform with joint actions, mapped to `joints`; None if the actions move
        the TCP.

        Raises:
            ConfigurationError: `profile` and `joints` do not match the constants.
        """
        constants = self.platform()
        if (constants.state == "joints") != (self.profile == "joints"):
            raise ConfigurationError(
                f"constants = {self.constants!r} has the state {constants.state!r}, which does not "
                f"fit profile = {self.profile!r}.",
                hint='profile = "joints" belongs to constants whose state is "joints".',
            )
        if (constants.state == "joints") != (self.joints is not None):
            raise ConfigurationError(
                "The option 'joints' must be given exactly when profile is \"joints\"."
            )
        return None if self.joints is None else constants.rows()
