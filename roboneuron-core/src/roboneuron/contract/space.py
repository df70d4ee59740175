"""Control spaces: the meaning of an action's numbers, as named channels with unit, frame and arm.

The default is `EE_DELTA`, the contract's 7-vector. A backend may declare another space instead. Its
label is sent with each action, so that values are mapped by name, not by position.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from roboneuron.contract.arrays import F64
from roboneuron.contract.profile import RobotProfile
from roboneuron.errors import InvalidInputError, UnsafeError

ACTION_LABEL = "ee_delta_base"
"""`layout.dim[0].label` of the message of a 7-vector."""
ACTION_FIELDS = ("dx_m", "dy_m", "dz_m", "rx_rad", "ry_rad", "rz_rad", "gripper_open")
"""Meaning and unit of each value of a 7-vector, in order."""
SPACE_KINDS = ("ee_delta", "ee_pose", "joint_position", "joint_velocity", "joint_delta")
"""Kinds of control spaces.

- `ee_delta`: displacement of the TCP, see `roboneuron.contract.action`.
- `ee_pose`: absolute pose of the TCP in the base frame: x y z [m], quaternion qx qy qz qw.
- `joint_position`: absolute joint positions [rad, m of slides].
- `joint_velocity`: joint velocities [rad/s, m/s of slides], each held for one period of the chunk.
- `joint_delta`: joint positions relative to the joints measured with the observation. Inference
  adds those, and publishes `joint_position`.
"""
GRIPPER = "gripper_open"
"""Name of a gripper's channel: its absolute opening, 0 closed .. 1 open, in every space."""
OPENING = "opening"
GREATEST_RATE_HZ = 1000.0
_LEAST_NORM, _GREATEST_NORM = 0.9, 1.1
"""Range of quaternion lengths that rounding and a cross-fade of consecutive rows can explain."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Channel:
    """One number of an action.

    Attributes:
        name: name of the joint, `GRIPPER`, or name of a coordinate ("x", "qw").
        unit: "m", "rad", "m/s", "rad/s", "1" (quaternions) or "opening" (0 closed .. 1 open).
        frame: "base" for coordinates of the TCP; "" for joints and grippers.
        arm: name of the arm on a robot with several; "" for the only one.
    """

    name: str
    unit: str
    frame: str = ""
    arm: str = ""

    @property
    def key(self) -> str:
        """Name in labels and messages: "x", "left/x"."""
        return f"{self.arm}/{self.name}" if self.arm else self.name


def _quaternions(keys: Sequence[str]) -> Iterator[list[int]]:
    """Positions of x y z w of each arm that has all four."""
    for key in keys:
        arm, is_first, rest = key.rpartition("qx")
        parts = [f"{arm}q{axis}" for axis in "xyzw"]
        if is_first and not rest and arm[-1:] in ("", "/") and set(parts) <= set(keys):
            yield [keys.index(part) for part in parts]


@dataclass(frozen=True, kw_only=True)
class ControlSpace:
    """Meaning of one row of a chunk.

    Attributes:
        kind: one of `SPACE_KINDS`.
        channels: meaning of each value, in order.
        rate_hz: rows per second that the policy was trained for; 0 for any rate.

    Raises:
        InvalidInputError: the kind or the rate is invalid, or a channel occurs twice.
    """

    kind: str
    channels: tuple[Channel, ...]
    rate_hz: float = 0.0

    def __post_init__(self) -> None:
        keys = [channel.key for channel in self.channels]
        if self.kind not in SPACE_KINDS:
            raise InvalidInputError(
                f"{self.kind!r} is no control space; there are: {', '.join(SPACE_KINDS)}."
            )
        if not 0.0 <= self.rate_hz <= GREATEST_RATE_HZ:
            raise InvalidInputError(
                f"A rate of {self.rate_hz} Hz is none; expected 0 .. {GREATEST_RATE_HZ:g} Hz."
            )
        if len(set(keys)) != len(keys) or not keys:
            raise InvalidInputError(f"The channels of {self.kind!r} are not distinct: {keys}.")

    @cached_property
    def label(self) -> str:
        """Kind, rate and names of the channels, as the action message carries them:
        "joint_velocity@15:fr3_joint1,fr3_joint2,gripper_open"; `ACTION_LABEL` for `EE_DELTA`.
        """
        rate = f"@{self.rate_hz:g}" if self.rate_hz else ""
        label = f"{self.kind}{rate}:{','.join(self.keys)}"
        return ACTION_LABEL if label == f"ee_delta:{','.join(ACTION_FIELDS)}" else label

    @cached_property
    def quaternions(self) -> tuple[list[int], ...]:
        """Positions of x y z w of each quaternion, in whatever order they occur."""
        return tuple(_quaternions(self.keys))

    @cached_property
    def _grippers(self) -> tuple[int, ...]:
        return tuple(i for i, channel in enumerate(self.channels) if channel.name == GRIPPER)

    @property
    def is_absolute(self) -> bool:
        """True if a row is an absolute target, independent of earlier rows."""
        return self.kind in ("ee_pose", "joint_position")

    @property
    def size(self) -> int:
        """Values in one row."""
        return len(self.channels)

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the channels, in order."""
        return tuple(channel.key for channel in self.channels)

    def check(self, values: ArrayLike) -> F64:
        """Return one row as a float64 array of shape (size,).

        Raises:
            InvalidInputError: another size, an opening outside 0 .. 1, an invalid quaternion.
            UnsafeError: a value is NaN or infinite.
        """
        row = np.asarray(values, dtype=np.float64)
        if row.shape != (self.size,):
            raise InvalidInputError(
                f"An action has shape {row.shape}, expected ({self.size},): {self.keys}."
            )
        numbers = row.tolist()  # on so few, numpy takes longer than Python
        if not all(map(math.isfinite, numbers)):
            key, value = next(
                pair for pair in zip(self.keys, numbers, strict=True) if not math.isfinite(pair[1])
            )
            raise UnsafeError(f"An action holds a non-finite value at {key} ({value}).")
        for i in self._grippers:
            if not 0.0 <= numbers[i] <= 1.0:
                raise InvalidInputError(
                    f"{self.keys[i]} is {numbers[i]:g}, expected a value in [0 closed, 1 open]."
                )
        for part in self.quaternions:
            norm = math.hypot(*(numbers[i] for i in part))
            if not _LEAST_NORM <= norm <= _GREATEST_NORM:
                raise InvalidInputError(
                    f"{', '.join(self.keys[i] for i in part)} have the length {norm:.4g}, expected "
                    "1."
                )
        return row


EE_DELTA = ControlSpace(
    kind="ee_delta",
    channels=(
        *(Channel(name=name, unit="m", frame="base") for name in ACTION_FIELDS[:3]),
        *(Channel(name=name, unit="rad", frame="base") for name in ACTION_FIELDS[3:6]),
        Channel(name=GRIPPER, unit=OPENING),
    ),
)
"""The contract's 7-vector."""


def channel_keys(label: str) -> tuple[str, ...]:
    """Channel names in a label."""
    return ACTION_FIELDS if label == ACTION_LABEL else tuple(label.partition(":")[2].split(","))


def robot_space(kind: str, profile: RobotProfile, rate_hz: float = 0.0) -> ControlSpace:
    """The space of that kind on this robot: arm by arm its joints in the profile's order, followed
    by its gripper, if any.

    Raises:
        InvalidInputError: the kind is unknown, the robot has no arm, or it has several and the kind
            is `ee_delta`.
    """
    if kind == "ee_delta":
        if profile.arms:
            raise InvalidInputError(
                f"{kind!r} moves one arm; robot {profile.name!r} has {len(profile.arms)}.",
                hint="Take 'ee_pose' or a space of joints, whose channels name the arm.",
            )
        return EE_DELTA
    if not profile.arm_joints:
        raise InvalidInputError(f"Robot {profile.name!r} has no arm that {kind!r} could move.")
    slides = profile.kinds.prismatic
    per_s = "/s" if kind == "joint_velocity" else ""
    channels: list[Channel] = []
    for arm in profile.each_arm:
        if kind == "ee_pose":
            channels += [Channel(name=x, unit="m", frame="base", arm=arm.name) for x in "xyz"]
            channels += [
                Channel(name=f"q{x}", unit="1", frame="base", arm=arm.name) for x in "xyzw"
            ]
        else:
            channels += [
                Channel(name=x, unit=("m" if x in slides else "rad") + per_s, arm=arm.name)
                for x in arm.joints
            ]
        if arm.gripper is not None:
            channels.append(Channel(name=GRIPPER, unit=OPENING, arm=arm.name))
    return ControlSpace(kind=kind, channels=tuple(channels), rate_hz=rate_hz)
