"""Options under `[plugins.lerobot]`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_backend_lerobot.channels import Meaning, Unit
from roboneuron import ConfigurationOnly

Role = Annotated[str, Field(pattern=r"^([a-z][a-z0-9_]*|-)$")]
Name = Annotated[str, Field(min_length=1, max_length=120)]
SpaceKind = Literal["joint_position", "joint_delta", "joint_velocity", "ee_delta", "ee_pose"]
Images = Literal["exact", "resized", "any"]
Schedule = Literal["linear", "exp", "ones", "zeros"]


class ChannelOptions(BaseModel):
    """Mapping of one number of the policy to the robot."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    to: Name = Field(
        description="the robot's joint, 'gripper_open', or a coordinate of the TCP ('x', 'qw', "
        "'dx_m'); on a robot with several arms 'left/...'"
    )
    unit: Unit = Field(description="unit of the policy's number")
    sign: Literal[1, -1] = Field(default=1, description="-1 if the policy's direction is opposite")
    offset: float = Field(
        default=0.0, description="the policy's number at the robot's value 0 [unit]"
    )
    scale: float = Field(default=1.0, gt=0, description="units per 1.0 of the policy's number")
    low: float | None = Field(
        default=None, description="for the units range_...: the robot's value at the lower end"
    )
    high: float | None = Field(
        default=None, description="for the units range_...: the robot's value at the upper end"
    )

    @model_validator(mode="after")
    def _ends_belong_to_ranges(self) -> Self:
        is_range = self.unit.startswith("range_")
        if is_range != (self.low is not None and self.high is not None):
            raise ValueError("low and high must be given exactly with the units range_...")
        if is_range and (self.sign != 1 or self.offset or self.scale != 1.0):
            raise ValueError("low and high define the mapping: leave out sign, offset and scale")
        if is_range and self.low == self.high:
            raise ValueError("low and high must differ")
        return self

    def meaning(self, name: str) -> Meaning:
        """The mapping as a `Meaning` with this name."""
        return Meaning(
            name=name,
            to=self.to,
            unit=self.unit,
            sign=self.sign,
            offset=self.offset,
            scale=self.scale,
            low=self.low,
            high=self.high,
        )


class LeRobotOptions(BaseModel):
    """Options of the backend "lerobot"."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    checkpoint: Annotated[Path, ConfigurationOnly()] = Field(
        description="folder that LeRobot's save_pretrained wrote (config.json, model.safetensors, "
        "policy_preprocessor.json, policy_postprocessor.json)"
    )
    rate_hz: float = Field(gt=0, le=1000, description="rows per second of the training data [Hz]")
    space: SpaceKind = Field(
        default="joint_position", description="control space of the un-normalised action"
    )
    joints: Annotated[tuple[Name, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="short form of `channels`: target of each number of the action, in the "
        "policy's order, for instance the robot's joints and 'gripper_open'",
    )
    joint_unit: Literal["radians", "degrees"] | None = Field(
        default=None, description="unit of all `joints` except grippers"
    )
    gripper_unit: (
        Literal["open_fraction", "closed_fraction", "open_percent", "closed_percent"] | None
    ) = Field(default=None, description="unit of the grippers among `joints`")
    names: Annotated[tuple[Name, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="names of the action's numbers in the policy's order; needed with `channels` "
        "if the checkpoint does not contain them",
    )
    state_names: Annotated[tuple[Name, ...], Field(max_length=64)] | None = Field(
        default=None,
        description="names of the state's numbers, likewise; those of the action if unset",
    )
    channels: dict[Name, ChannelOptions] = Field(
        default={}, description="mapping of each named number of action and state to the robot"
    )
    cameras: dict[Name, Role] = Field(
        default={},
        description="camera role by the policy's image feature ('observation.images.front' or "
        "'front'); '-' leaves out one that the policy does not need. Unset: features that are "
        "named like a role or a camera of the robot",
    )
    images: Images = Field(
        default="exact",
        description="'exact' refuses images of another size than the policy's, 'resized' "
        "stretches them, 'any' leaves them to the policy",
    )
    folders: Annotated[dict[Name, Path], ConfigurationOnly()] = Field(
        default={},
        description="local folder by the hub's name, for backbones and tokenizers that the "
        "checkpoint names; nothing is looked up on the hub",
    )
    robot_type: str = Field(
        default="",
        max_length=120,
        description="robot_type of the training data, if the policy uses it",
    )
    action_steps: int | None = Field(
        default=None, ge=1, description="rows of a chunk to execute; the checkpoint's if unset"
    )
    device: str = Field(
        default="auto",
        pattern=r"^(auto|cpu|cuda(:\d+)?)$",
        description="auto takes a GPU if there is one",
    )
    threads: int | None = Field(
        default=None, ge=1, le=512, description="threads of PyTorch; its default if unset"
    )
    seed: Annotated[int, Field(ge=0)] | Literal["random"] = Field(
        default=0, description="seed of the noise, restarted by every reset; 'random' for none"
    )
    rtc: bool = Field(
        default=True,
        description="continue the rows that are executed during inference, if the policy can",
    )
    rtc_horizon: int | None = Field(
        default=None, ge=1, description="number of guided rows; all remaining ones if unset"
    )
    rtc_schedule: Schedule = Field(
        default="linear", description="decrease of the guidance after the committed rows"
    )
    rtc_max_weight: float = Field(
        default=10.0, gt=0, le=1000, description="greatest weight of the guidance"
    )

    @model_validator(mode="after")
    def _numbers_have_one_meaning(self) -> Self:
        if (self.joints is None) == (not self.channels):
            raise ValueError("give either joints or channels")
        if self.joints is None:
            return self
        if self.names is not None or self.state_names is not None:
            raise ValueError("names and state_names belong to channels, not to joints")
        if self.joint_unit is None:
            raise ValueError("joints needs joint_unit ('radians' or 'degrees')")
        has_gripper = any(name.rpartition("/")[2] == "gripper_open" for name in self.joints)
        if has_gripper != (self.gripper_unit is not None):
            raise ValueError("gripper_unit must be given exactly when joints has 'gripper_open'")
        if len(set(self.joints)) != len(self.joints):
            raise ValueError("joints names one twice")
        return self

    def meanings(self) -> dict[str, Meaning]:
        """Meaning of each number by its name; with `joints` the name is that of the joint."""
        if self.joints is None:
            return {name: channel.meaning(name) for name, channel in self.channels.items()}
        found: dict[str, Meaning] = {}
        for name in self.joints:
            is_gripper = name.rpartition("/")[2] == "gripper_open"
            unit = self.gripper_unit if is_gripper else self.joint_unit
            assert unit is not None  # checked by the validator
            found[name] = Meaning(name=name, to=name, unit=unit)
        return found
