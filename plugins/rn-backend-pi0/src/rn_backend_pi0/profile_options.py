"""Options that define the meaning of a model's states and actions."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rn_backend_pi0.conversion import Conversion, JointConversion, TcpConversion
from rn_backend_pi0.profiles import JOINT_PROFILES
from rn_vla.letterbox import Flip
from rn_vla.tcp_profiles import (
    PROFILES,
    ActionOptions,
    OptionSection,
    Profile,
    StateOptions,
    Vector,
    own_profile,
)
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


class ProfileOptions(OptionSection):
    """Options of every backend that define the meaning of the model's numbers."""

    profile: ProfileName | None = Field(
        default=None,
        description="meaning of state and actions; from the checkpoint's roboneuron.json if unset",
    )
    joints: Annotated[tuple[str, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="for profiles that move joints: the robot's names of the policy's joints, in "
        "the policy's order (each arm from the base to the tip); joints are never mapped by "
        "position",
    )
    state: StateOptions | None = Field(default=None, description="for profile 'own'")
    action: ActionOptions | None = Field(default=None, description="for profile 'own'")
    base_position_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="position of the robot's base in the frame of the training data [m]",
    )
    action_steps: int | None = Field(
        default=None, ge=1, description="actions of a chunk to execute before the next one"
    )
    image_flip: Flip = Field(
        default="none",
        description="converts upright images to the orientation of the training data",
    )

    @model_validator(mode="after")
    def _own_is_complete(self) -> Self:
        own = self.profile == "own"
        if own and (self.state is None or self.action is None):
            raise ValueError("profile 'own' needs the tables 'state' and 'action'")
        if not own and (self.state is not None or self.action is not None):
            raise ValueError("the tables 'state' and 'action' are only read with profile 'own'")
        return self

    def resolve_conversion(self, declared: str = "") -> Conversion:
        """The conversion of the chosen profile, which moves the TCP or joints.

        Args:
            declared: profile named by the checkpoint; used if the user sets none.

        Raises:
            ConfigurationError: as `resolve_profile`, or the option `joints` is missing, does not
                match, or is unused.
        """
        name = self.profile or declared
        if name not in JOINT_PROFILES:
            if self.joints is not None:
                raise ConfigurationError(
                    "The option 'joints' has no effect: the profile moves the TCP.",
                    hint=f"Profiles that move joints: {', '.join(JOINT_PROFILES)}.",
                )
            return TcpConversion(self.resolve_profile(declared), np.array(self.base_position_m))
        if self.joints is None:
            raise ConfigurationError(
                f"Profile {name!r} needs the option 'joints': the robot's joints in the policy's "
                "order."
            )
        return JointConversion(JOINT_PROFILES[name], self.joints)

    def resolve_profile(self, declared: str = "") -> Profile:
        """The chosen profile, among those that move the TCP.

        Args:
            declared: profile named by the checkpoint; used if the user sets none.

        Raises:
            ConfigurationError: neither names one, or the checkpoint names an unknown one.
        """
        name = self.profile or declared
        if name == "own" and self.state is not None and self.action is not None:
            profile = own_profile(self.state, self.action)
        elif name in PROFILES:
            profile = PROFILES[name]
        else:
            got = f", and the checkpoint names the unknown {name!r}" if name else ""
            known = (*PROFILES, "own", *JOINT_PROFILES)
            raise ConfigurationError(
                f"The option 'profile' is not set{got}; choose one of {', '.join(known)}.",
                hint="The profile defines the model's state and its actions' meaning; it "
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
