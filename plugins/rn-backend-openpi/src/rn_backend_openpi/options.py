"""Options of the interface of a served policy, which client and server share, and those under
`[plugins.openpi]`.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rn_backend_openpi.conventions import GripperValue, PoseRotation
from rn_backend_openpi.layout import Axes
from rn_backend_openpi.rows import JointKind
from rn_vla.letterbox import Flip
from rn_vla.normalisation import ScalingKind
from rn_vla.tcp_profiles import ActionOptions, OptionSection, Vector
from rn_vla.tcp_state import StateTerm
from roboneuron import AgentMaySet, ConfigurationOnly

log = logging.getLogger(__name__)
PLAIN, OWN = "roboneuron", "own"
ProfileName = Literal[
    "libero",
    "bridge",
    "droid",
    "droid-position",
    "roboarena",
    "franka",
    "ur5e",
    "aloha",
    "roboneuron",
    "own",
]
SpaceKind = Literal["ee_delta", "ee_pose", "joint_position", "joint_velocity", "joint_delta"]
_PLAIN_ONLY = {"space", "rate_hz", "slides", "grippers"}
_OLD = frozenset({"answer_timeout_s", "send_timeout_s", "idle_timeout_s", "precision"})
"""Options of the server of earlier releases."""
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
    space: SpaceKind = Field(
        default="ee_delta", description="profile 'roboneuron': control space of the server's rows"
    )
    rate_hz: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="profile 'roboneuron': rows per second; 0: taken from each answer",
    )
    joints: Annotated[tuple[Name, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="the robot's names of the policy's joints, in the policy's order (each arm "
        "from the base to the tip); joints are never mapped by position",
    )
    slides: Annotated[tuple[Name, ...], Field(max_length=64)] = Field(
        default=(), description="profile 'roboneuron': the prismatic ones among the joints"
    )
    arms: Annotated[tuple[Name, ...], Field(max_length=8)] = Field(
        default=(), description="profiles 'roboneuron' and 'own': names of several arms, in order"
    )
    grippers: bool = Field(default=True, description="profile 'roboneuron': each arm has a gripper")
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

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if (self.profile == OWN) != (self.action is not None):
            raise ValueError("profile 'own', and no other, needs the table 'action'")
        if self.profile == OWN and not self.state_keys:
            raise ValueError("profile 'own' needs state_keys")
        if self.arms and self.profile not in (OWN, PLAIN):
            raise ValueError("arms is read by the profiles 'own' and 'roboneuron' only")
        unread = _PLAIN_ONLY & self.model_fields_set
        if unread and self.profile not in (PLAIN, None):
            raise ValueError(f"{', '.join(sorted(unread))}: read by the profile 'roboneuron' only")
        return self

    def interface(self) -> InterfaceOptions:
        """These options without those of a client."""
        own = self.model_dump(include=set(InterfaceOptions.model_fields), exclude_unset=True)
        return InterfaceOptions.model_validate(own)


class ServerOptions(OptionSection):
    """Options of `roboneuron openpi-server`, as `[listen]` and `[models.NAME]` of
    `roboneuron serve-policy` have them.
    """

    # no default address: an agent that chose this backend would otherwise be refused because of it
    host: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, min_length=1, description="address to listen on; 127.0.0.1 if unset"
    )
    port: int = Field(default=8000, ge=0, le=65535, description="port; 0 for any free one")
    token_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="file with the key that clients send as Api-Key"
    )
    certificate: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of the server; enables wss://"
    )
    certificate_key: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of its private key; read from `certificate` if unset"
    )
    insecure: bool = Field(
        default=False,
        description="listen beyond this machine without token and certificate; logged",
    )
    clients: int = Field(default=16, ge=1, le=100, description="most connections")
    waiting: int = Field(default=64, ge=1, le=4096, description="most observations in the queue")
    most: int = Field(default=8, ge=1, le=256, description="most observations in one batch")
    linger_s: float = Field(
        default=0.003, ge=0, le=0.1, description="wait of an idle server for further robots [s]"
    )
    stateless: bool = Field(
        default=False,
        description="serve a backend without batches; only one that keeps no history",
    )

    @model_validator(mode="before")
    @classmethod
    def _without_old(cls, given: object) -> object:
        if not isinstance(given, dict) or not _OLD & given.keys():
            return given
        log.warning("[plugins.openpi.server] has no %s any more.", ", ".join(_OLD & given.keys()))
        return {name: value for name, value in given.items() if name not in _OLD}


class NormalisationOptions(OptionSection):
    """Statistics of the served checkpoint's training data."""

    file: Annotated[Path, ConfigurationOnly()] = Field(description="openpi's norm_stats.json")
    kind: ScalingKind = Field(description="'quantiles' for pi0.5, 'mean_std' for pi0")


class OpenpiOptions(InterfaceOptions):
    """Options of the backend "openpi", and of `roboneuron openpi-server`."""

    engine: Literal["sglang", "vllm-omni"] | None = Field(
        default=None,
        description="the engine that serves a LeRobot checkpoint: its path, its names, rows padded "
        "to the network's width",
    )
    normalisation: NormalisationOptions | Literal["server"] | None = Field(
        default=None,
        description="of an engine: the statistics by which the client converts states and rows; "
        "'server' if the engine does",
    )
    url: Annotated[str, ConfigurationOnly()] = Field(
        default="ws://127.0.0.1:8000",
        pattern=r"^wss?://\S+$",
        description="address of the policy server, with its path if it has one",
    )
    api_key_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="file with the API key"
    )
    api_key_variable: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, description="name of the environment variable with the API key"
    )
    allow_insecure_key: Annotated[bool, ConfigurationOnly()] = Field(
        default=False, description="send the key over an unencrypted remote connection"
    )
    ca_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of the authority that signed a wss:// server's certificate"
    )
    connect_timeout_s: float = Field(
        default=10.0, gt=0, le=600, description="longest wait for the server during load [s]"
    )
    warm_up_timeout_s: float = Field(
        default=120.0, gt=0, le=600, description="limit of the first inference (compilation) [s]"
    )
    request_timeout_s: float = Field(
        default=1.5, gt=0, le=60, description="limit of one inference with reconnection [s]"
    )
    action_keys: Annotated[tuple[Key, ...], Field(min_length=1, max_length=16), AgentMaySet()] = (
        Field(default=("actions",), description="arrays of the answer, concatenated in this order")
    )
    action_steps: int | None = Field(
        default=None, ge=1, description="actions of a chunk to execute before the next one"
    )
    server: Annotated[ServerOptions, ConfigurationOnly()] = Field(
        default=ServerOptions(), description="options of `roboneuron openpi-server`"
    )

    @property
    def is_bare(self) -> bool:
        """True if the engine serves the network of a LeRobot checkpoint; DreamZero is no such."""
        return self.engine is not None and self.profile != "roboarena"

    @model_validator(mode="after")
    def _fits_the_engine(self) -> Self:
        if self.is_bare and self.profile == PLAIN:
            raise ValueError("an engine serves none of RoboNeuron's rows; choose another profile")
        if self.is_bare and self.normalisation is None:
            raise ValueError(
                "an engine needs normalisation: a table with file and kind, or 'server'"
            )
        if not self.is_bare and self.normalisation is not None:
            raise ValueError("normalisation belongs to an engine")
        return self

    @model_validator(mode="after")
    def _has_one_key(self) -> Self:
        if self.api_key_file is not None and self.api_key_variable is not None:
            raise ValueError("give api_key_file or api_key_variable, not both")
        return self
