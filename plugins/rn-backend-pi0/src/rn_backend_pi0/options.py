"""What a user may set under `[plugins.pi0]`, `[plugins.pi0-fast]` and `[plugins.pi0-remote]`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_backend_pi0.action_layout import ActionLayout, FrameName, Gripper, Meaning, Rotation
from rn_backend_pi0.chunking import Jacobian, Schedule
from rn_backend_pi0.conversion import Conversion, JointConversion, TcpConversion
from rn_backend_pi0.fast_tokens import FastLength
from rn_backend_pi0.image import Flip, Resize
from rn_backend_pi0.profiles import JOINT_PROFILES, PROFILES, Profile
from rn_backend_pi0.state import StateLayout, StateTerm
from roboneuron import AgentMaySet, ConfigurationError, ConfigurationOnly

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
Role = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*|-)$")]
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


class _Common(_Section):
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


class NativeOptions(_Common):
    """Options of the backends that run a checkpoint in this process."""

    checkpoint: Annotated[Path, ConfigurationOnly()] = Field(
        description="directory of a LeRobot or openpi PyTorch checkpoint"
    )
    tokenizer: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="tokenizer.json; the checkpoint's own when not given"
    )
    asset_id: str | None = Field(
        default=None, description="which statistics of an openpi checkpoint that has several"
    )
    camera_slots: tuple[Role, ...] | None = Field(
        default=None, description="camera role for each slot of the model, '-' for an empty one"
    )
    optional_roles: tuple[Role, ...] = Field(
        default=("wrist",), description="roles that may be absent; their slot is then masked"
    )
    device: str = Field(
        default="auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?)$",
        description="auto takes a GPU if there is one",
    )
    dtype: Literal["auto", "float32", "bfloat16"] = Field(
        default="auto", description="auto is bfloat16 on a GPU and float32 on a CPU"
    )
    cpu_threads: int | None = Field(
        default=None,
        ge=1,
        le=512,
        description="threads of PyTorch in this process; PyTorch's own choice if unset",
    )
    numerics: Literal["lerobot", "openpi"] | None = Field(
        default=None,
        description="whose rounding, resizing and eps to follow; the family that wrote the "
        "checkpoint if unset",
    )
    resize: Resize | None = Field(
        default=None,
        description="'antialiased' as openpi serves, 'plain' as LeRobot; by numerics if unset",
    )


class Pi0Options(NativeOptions):
    """Options of the backend "pi0"."""

    state_in_prompt: bool = Field(
        default=True,
        description="pi0.5: the prompt names the state; false for checkpoints that were trained "
        "without (openpi's pi05_libero), which see no state at all",
    )
    denoising_steps: int | None = Field(
        default=None, ge=1, le=1000, description="Euler steps; the checkpoint's if unset"
    )
    seed: Annotated[int, Field(ge=0)] | Literal["random"] = Field(
        default=0,
        description="of the noise, restarted by every reset; 'random' for another one each time",
    )
    noise: Literal["fresh", "fixed"] = Field(
        default="fresh", description="'fixed' starts every inference from the same noise"
    )
    rtc: bool = Field(
        default=True, description="continue the rows that are played meanwhile (real-time chunking)"
    )
    rtc_schedule: Schedule = Field(
        default="linear",
        description="how the guidance falls after the rows that will be played in any case",
    )
    rtc_horizon: int | None = Field(
        default=None, ge=1, description="rows that are guided; all that are left if unset"
    )
    rtc_max_weight: float = Field(
        default=10.0, gt=0, le=1000, description="greatest weight of the guidance"
    )
    rtc_jacobian: Jacobian = Field(
        default="identity",
        description="'full' adds a backward pass to each step, as in the paper; slower",
    )

    @property
    def numpy_seed(self) -> int | None:
        """The seed as numpy takes it."""
        return None if self.seed == "random" else self.seed

    @model_validator(mode="after")
    def _fixed_noise_has_a_seed(self) -> Self:
        if self.noise == "fixed" and self.seed == "random":
            raise ValueError("noise 'fixed' needs a seed")
        return self


class Pi0FastOptions(NativeOptions):
    """Options of the backend "pi0-fast"."""

    action_tokenizer: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        description="directory of the action tokenizer's files; the checkpoint's "
        "action_tokenizer when not given",
    )
    max_outside_share: float = Field(
        default=0.15,
        ge=0,
        le=1,
        description="share of an answer's tokens for which another token than every "
        "action token may be the likeliest; more is refused",
    )
    fast_length: FastLength = Field(
        default="exact",
        description="'padded' takes coefficients that are missing at the end as 0 and "
        "drops surplus ones, as LeRobot does",
    )


class Pi0RemoteOptions(_Common):
    """Options of the remote backend."""

    url: Annotated[str, ConfigurationOnly()] = Field(
        default="ws://127.0.0.1:8000",
        pattern=r"^wss?://\S+$",
        description="of openpi's policy server",
    )
    api_key_variable: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, description="name of the environment variable with the API key"
    )
    allow_insecure_key: Annotated[bool, ConfigurationOnly()] = Field(
        default=False, description="send the key over an unencrypted remote connection"
    )
    connect_timeout_s: float = Field(
        default=10.0, gt=0, le=600, description="until the server answers, during load"
    )
    warm_up_timeout_s: float = Field(
        default=120.0, gt=0, le=600, description="for the first inference (compilation)"
    )
    request_timeout_s: float = Field(
        default=1.5, gt=0, le=60, description="for one inference, reconnecting included"
    )
    image_keys: Annotated[dict[Role, str], AgentMaySet()] = Field(
        default={"primary": "observation/image", "wrist": "observation/wrist_image"},
        min_length=1,
        description="key of the request by camera role",
    )
    state_key: Annotated[str, AgentMaySet()] = Field(
        default="observation/state", min_length=1, description="key of the state"
    )
    joint_key: Annotated[str | None, AgentMaySet()] = Field(
        default=None,
        min_length=1,
        description="key of the joints, for servers that take them beside the gripper "
        "(openpi's DROID: 'observation/joint_position'); otherwise all goes under state_key",
    )
    gripper_key: Annotated[str | None, AgentMaySet()] = Field(
        default=None,
        min_length=1,
        description="key of the gripper then (openpi's DROID: 'observation/gripper_position')",
    )
    prompt_key: Annotated[str, AgentMaySet()] = Field(
        default="prompt", min_length=1, description="key of the instruction"
    )
    image_side_px: int = Field(
        default=224, ge=16, le=1024, description="images are sent as squares of this side"
    )

    @model_validator(mode="after")
    def _joints_and_gripper_have_a_key_each(self) -> Self:
        if (self.joint_key is None) != (self.gripper_key is None):
            raise ValueError("joint_key and gripper_key must be given together")
        return self
