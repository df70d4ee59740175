"""Options that say what a model's states and actions mean."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_backend_pi0.action_layout import ActionLayout, FrameName, Gripper, Meaning, Rotation
from rn_backend_pi0.conversion import Conversion, JointConversion, TcpConversion
from rn_backend_pi0.image import Flip
from rn_backend_pi0.profiles import JOINT_PROFILES, PROFILES, Profile
from rn_backend_pi0.state import StateLayout, StateTerm
from roboneuron import ConfigurationError

ProfileName = Literal[
    "libero",
    "libero-openpi",
    "bridge",
    "own",
    "droid",
    "droid-position",
    "franka",
    "ur5e",
    "aloha",
    "aloha-absolute",
    "aloha-plain",
    "aloha-plain-absolute",
]
Vector = tuple[float, float, float]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class StateOptions(_Section):
    """The state vector of an own profile."""

    terms: tuple[StateTerm, ...] = Field(
        min_length=1, description="parts of the state vector, in order"
    )
    joint_names: tuple[str, ...] = Field(
        default=(), description="joints of the term 'joints', in order"
    )
    rotvec_near_rad: Vector = Field(
        default=(0.0, 0.0, 0.0), description="which of two rotation vectors is written [rad]"
    )
    finger_travel_m: float = Field(
        default=0.04, gt=0, description="position of one finger joint when open [m]"
    )

    @model_validator(mode="after")
    def _joints_are_named(self) -> Self:
        if ("joints" in self.terms) != bool(self.joint_names):
            raise ValueError("joint_names must be given exactly when terms has 'joints'")
        return self


class ActionOptions(_Section):
    """The action values of an own profile."""

    meaning: Meaning = Field(description="'delta' moves by, 'absolute' moves to")
    frame: FrameName = Field(description="axes of a delta: 'base' or 'tcp'")
    rotation: Rotation = Field(description="'rotvec', or 'rpy' about fixed axes")
    gripper: Gripper = Field(description="meaning of the last value")
    step_s: float = Field(gt=0, le=10, description="time between two actions [s]")
    translation_scale_m: float = Field(default=1.0, gt=0, description="metres of one unit")
    rotation_scale_rad: float = Field(default=1.0, gt=0, description="radians of one unit")
    limit: float = Field(
        default=0.0, ge=0, description="clip the first six values to +-limit; 0 for no clipping"
    )
    adds_state: bool = Field(
        default=False, description="the first six values are relative to the state"
    )


class ProfileOptions(_Section):
    """Options of every backend: what the model's numbers mean."""

    profile: ProfileName | None = Field(
        default=None,
        description="what state and actions mean; the checkpoint's roboneuron.json when not given",
    )
    joints: Annotated[tuple[str, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="for profiles that move joints: the robot's names of the policy's joints, in "
        "the policy's order (each arm from the base to the tip); nothing is mapped by place "
        "otherwise",
    )
    state: StateOptions | None = Field(default=None, description="for profile 'own'")
    action: ActionOptions | None = Field(default=None, description="for profile 'own'")
    base_position_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="where the robot's base stands in the frame of the training data [m]",
    )
    action_steps: int | None = Field(
        default=None, ge=1, description="actions of a chunk to execute before the next one"
    )
    image_flip: Flip = Field(
        default="none", description="turns upright camera images into what the model was trained on"
    )

    @model_validator(mode="after")
    def _own_is_complete(self) -> Self:
        own = self.profile == "own"
        if own and (self.state is None or self.action is None):
            raise ValueError("profile 'own' needs the tables 'state' and 'action'")
        if not own and (self.state is not None or self.action is not None):
            raise ValueError("the tables 'state' and 'action' are only read with profile 'own'")
        return self

    def resolve_conversion(self, declared: str = "", *, served: bool = False) -> Conversion:
        """The conversion to use, of a profile that moves the TCP or joints.

        Args:
            declared: what the checkpoint says of itself; used when the user gives none.
            served: see `JointConversion`.

        Raises:
            ConfigurationError: as `resolve_profile`, or the option `joints` is missing, does not
                fit, or has no use.
        """
        name = self.profile or declared
        if name not in JOINT_PROFILES:
            if self.joints is not None:
                raise ConfigurationError(
                    "The option 'joints' has no use: the profile moves the TCP.",
                    hint=f"Profiles that move joints: {', '.join(JOINT_PROFILES)}.",
                )
            return TcpConversion(self.resolve_profile(declared), np.array(self.base_position_m))
        if self.joints is None:
            raise ConfigurationError(
                f"Profile {name!r} needs the option 'joints': the robot's joints in the policy's "
                "order."
            )
        return JointConversion(JOINT_PROFILES[name], self.joints, served)

    def resolve_profile(self, declared: str = "") -> Profile:
        """The profile to use, of those that move the TCP.

        Args:
            declared: what the checkpoint says of itself; used when the user gives none.

        Raises:
            ConfigurationError: neither names one, or the checkpoint names an unknown one.
        """
        name = self.profile or declared
        if name == "own" and self.state is not None and self.action is not None:
            state = StateLayout(
                terms=self.state.terms,
                joint_names=self.state.joint_names,
                rotvec_near_rad=np.array(self.state.rotvec_near_rad),
                finger_travel_m=self.state.finger_travel_m,
            )
            profile = Profile(state=state, action=ActionLayout(**self.action.model_dump()))
        elif name in PROFILES:
            profile = PROFILES[name]
        else:
            got = f", and the checkpoint names the unknown {name!r}" if name else ""
            known = (*PROFILES, "own", *JOINT_PROFILES)
            raise ConfigurationError(
                f"The option 'profile' is not set{got}; choose one of {', '.join(known)}.",
                hint="The profile says what state the model takes and what its actions mean; it "
                "is never guessed.",
            )
        base = np.array(self.base_position_m)
        profile = replace(profile, state=replace(profile.state, base_position_m=base))
        if profile.action.adds_state and profile.state.width < 6:
            raise ConfigurationError(
                "adds_state needs a state of at least 6 values, this one has "
                f"{profile.state.width}."
            )
        return profile
