"""Options of the interface of a served policy, which a client and its server share."""

from __future__ import annotations

import logging
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, model_validator

from rn_backend_openpi.conventions import GripperValue, PoseRotation
from rn_backend_openpi.layout import Axes
from rn_backend_openpi.rows import JointKind
from rn_vla.letterbox import Flip
from rn_vla.tcp_profiles import ActionOptions, OptionSection, Vector
from rn_vla.tcp_state import StateTerm
from roboneuron import AgentMaySet, ConfigurationOnly

log = logging.getLogger(__name__)
OWN = "own"
ProfileName = Literal[
    "libero",
    "bridge",
    "droid",
    "droid-position",
    "roboarena",
    "franka",
    "ur5e",
    "aloha",
    "own",
    "roboneuron",
]
SpaceKind = Literal["ee_delta", "ee_pose", "joint_position", "joint_velocity", "joint_delta"]
_PLAIN = "roboneuron"
"""Profile of earlier releases, for servers of `roboneuron policy serve`; read until 0.2."""
_OF_PLAIN = frozenset({"rate_hz", "slides", "grippers"})
PROFILES = ", ".join(get_args(ProfileName)[:-1])
"""Names of the profiles, for messages."""
Role = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
Key = Annotated[str, Field(min_length=1, max_length=200)]
Name = Annotated[str, Field(min_length=1, max_length=200)]
Side = Annotated[int, Field(ge=16, le=4096)]
Rate = Annotated[float, Field(gt=0, le=1000)]


class DeltaAction(ActionOptions):
    """Actions that move the TCP of one arm."""

    kind: Literal["ee_delta"] = Field(description="control space")


class PoseAction(OptionSection):
    """Actions that are poses of the TCP, arm after arm."""

    kind: Literal["ee_pose"] = Field(description="control space")
    rotation: PoseRotation = Field(description="representation of rotations")
    gripper: GripperValue = Field(description="meaning of an arm's last value; 'none' without one")
    rate_hz: Rate = Field(description="rows per second")


class JointAction(OptionSection):
    """Joint actions, arm after arm."""

    kind: JointKind = Field(description="control space")
    gripper: GripperValue = Field(description="meaning of an arm's last value; 'none' without one")
    rate_hz: Rate = Field(description="rows per second")
    limit: float = Field(
        default=0.0, ge=0, description="clip joint values to +-limit; 0: no clipping"
    )
    scale: float = Field(default=1.0, gt=0, description="rad or rad/s per unit")


OwnAction = Annotated[DeltaAction | PoseAction | JointAction, Field(discriminator="kind")]


class SpaceOptions(OptionSection):
    """The control space of a model on another machine."""

    kind: str = Field(description="one of the contract's kinds, such as `joint_position`")
    rate_hz: float = Field(
        default=0.0, ge=0, le=1000, description="rows per second in training; 0 for any rate"
    )
    channels: Annotated[tuple[str, ...], Field(strict=False)] = Field(
        default=(),
        description="the robot's names of the policy's values, in the policy's order: joints, "
        "`gripper_open`, `left/x`. If unset: the robot's own order.",
    )


def put_option(options: OptionSection, name: str, value: object) -> None:
    """Set an option while the options are read; later they cannot be changed."""
    object.__setattr__(options, name, value)


class InterfaceOptions(OptionSection):
    """What the requests of openpi's clients hold, and what the answers mean: options that a client
    and its server share.
    """

    robot: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        description="of a server: the robot on whose joints the backend's control space depends",
    )
    dialect: Literal["auto", "openpi", "roboarena"] = Field(
        default="auto",
        description="'roboarena' (DreamZero, vLLM-Omni) adds endpoint and session_id to requests; "
        "'auto': according to the server's metadata",
    )
    profile: ProfileName | None = Field(
        default=None, description="the served policy's interface; never guessed"
    )
    joints: Annotated[tuple[Name, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="the robot's names of the policy's joints, in the policy's order (each arm "
        "from the base to the tip); joints are never mapped by position",
    )
    arms: Annotated[tuple[Name, ...], Field(max_length=8)] = Field(
        default=(), description="profile 'own': names of several arms, in order"
    )
    action: OwnAction | None = Field(default=None, description="profile 'own': the rows")
    state_keys: Annotated[dict[Key, tuple[StateTerm, ...]] | None, AgentMaySet()] = Field(
        default=None, description="state terms by key of the request; those of the profile if unset"
    )
    rotvec_near_rad: Vector | None = Field(
        default=None,
        description="choose the rotation vector nearer to this [rad]; the profile's if unset",
    )
    finger_travel_m: float = Field(
        default=0.04, gt=0, description="position of one finger joint when open [m]"
    )
    base_position_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="position of the robot's base in the frame of the training data [m]",
    )
    image_keys: Annotated[dict[Role, Key] | None, AgentMaySet()] = Field(
        default=None,
        min_length=1,
        description="key of the request by camera role; a dot separates nested maps",
    )
    image_size_px: tuple[Side, Side] | Literal["raw"] | None = Field(
        default=None,
        description="height and width for scaled images; the server's or the profile's if unset",
    )
    image_axes: Axes | None = Field(
        default=None, description="'chw': colour axis first; the profile's if unset"
    )
    image_flip: Flip = Field(
        default="none",
        description="converts upright images to the orientation of the training data",
    )
    prompt_key: Annotated[str, AgentMaySet()] = Field(
        default="prompt", min_length=1, description="key of the instruction"
    )

    space: Annotated[SpaceOptions | SpaceKind | None, ConfigurationOnly()] = Field(
        default=None,
        description="of a client without a profile: control space of a model on another machine, "
        "to know it before its server answers; the answers are checked against it",
    )
    rate_hz: float | None = Field(default=None, description="until 0.2: not needed any more")
    slides: tuple[Name, ...] | None = Field(default=None, description="likewise")
    grippers: bool | None = Field(default=None, description="likewise")

    @model_validator(mode="after")
    def _without_plain(self) -> Self:
        if self.profile != _PLAIN:
            return self
        unread = (InterfaceOptions.model_fields.keys() - {"robot"}) & self.model_fields_set
        if isinstance(self.space, SpaceOptions):
            unread -= {"space"}
        log.warning(
            "The profile 'roboneuron' is not needed any more: such a server is asked for cameras "
            "and control space. Leave out: %s.",
            ", ".join(sorted(unread)),
        )
        for name in unread:
            put_option(self, name, InterfaceOptions.model_fields[name].get_default())
            self.model_fields_set.discard(name)
        return self

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if (self.profile == OWN) != (self.action is not None):
            raise ValueError("profile 'own', and no other, needs the table 'action'")
        if self.profile == OWN and not self.state_keys:
            raise ValueError("profile 'own' needs state_keys")
        if self.arms and self.profile != OWN:
            raise ValueError("arms is read by the profile 'own' only")
        if isinstance(self.space, str) or _OF_PLAIN & self.model_fields_set:
            raise ValueError("rate_hz, slides, grippers and the name of a space are not read")
        of_a_profile = InterfaceOptions.model_fields.keys() - {"robot", "profile", "space"}
        unread = sorted(of_a_profile & self.model_fields_set)
        if unread and self.profile is None:
            raise ValueError(
                f"{', '.join(unread)}: read with a profile only; choose one of {PROFILES}"
            )
        return self
