"""Mapping of a data set's values to the robot's channels: by name, by position only on request."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rn_recorder_policy.demonstration import STATE, Column, Demonstration
from roboneuron import (
    GRIPPER,
    ArmProfile,
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    RobotProfile,
    nearest,
    robot_space,
)

F64 = NDArray[np.float64]
POSITION = ("x_m", "y_m", "z_m")
QUATERNION = ("qx", "qy", "qz", "qw")
_SUFFIXES = (".pos", ".vel")
"""Suffixes that lerobot's robots append to the names of motors."""
_ANGLES = ("rad", "rad/s")
_HINT = "Name them: --map NAME=CHANNEL, or --map FEATURE:NAME=CHANNEL; or say --in-order."


@dataclass(frozen=True, kw_only=True)
class NameMapping:
    """Interpretation of a data set's names.

    Attributes:
        renamed: channel by name, or by "feature:name".
        in_order: values are mapped by position, whatever their names.
        in_degrees: recorded angles are degrees.
    """

    renamed: Mapping[str, str] = field(default_factory=dict)
    in_order: bool = False
    in_degrees: bool = False

    def actions(self, demonstration: Demonstration, feature: str, space: ControlSpace) -> F64:
        """Return the recorded actions by channel, float64 (n, C).

        Raises:
            InvalidInputError: there is no such feature, or its names are not those of the space.
        """
        column = demonstration.columns.get(feature)
        if column is None:
            raise InvalidInputError(
                f"The data set has no feature {feature!r}.",
                hint=f"It has: {', '.join(demonstration.columns)}. Choose with --action.",
            )
        if self.in_order:
            if column.values.shape[1] != space.size:
                raise InvalidInputError(
                    f"{feature!r} has {column.values.shape[1]} values, the backend yields "
                    f"{space.size}: {', '.join(space.keys)}."
                )
            values = column.values.copy()
        else:
            found = self._by_channel(feature, column)
            missing = [key for key in space.keys if key not in found]
            if missing:
                told = ", ".join(column.names) if column.names else "none"
                raise InvalidInputError(
                    f"{feature!r} names no {', '.join(missing)}. It names: {told}.", hint=_HINT
                )
            values = np.stack([found[key] for key in space.keys], axis=1)
        if self.in_degrees:
            is_angle = [channel.unit in _ANGLES for channel in space.channels]
            values[:, is_angle] = np.radians(values[:, is_angle])
        return values

    def states(self, demonstration: Demonstration, profile: RobotProfile) -> RecordedStates:
        """Return the recorded states with known names."""
        found: dict[str, F64] = {}
        for feature, column in demonstration.columns.items():
            if feature.startswith("observation.") and not (self.in_order and feature == STATE):
                found = self._by_channel(feature, column) | found
        if self.in_order and STATE in demonstration.columns:
            names = (*profile.arm_joints, GRIPPER)
            places = demonstration.columns[STATE].values.T
            found |= dict(zip(names, places, strict=False))
        if self.in_degrees and profile.arm_joints:
            for channel in robot_space("joint_position", profile).channels:
                if channel.unit in _ANGLES and channel.name in found:
                    found[channel.name] = np.radians(found[channel.name])
        return RecordedStates(values=found)

    def check(self, demonstration: Demonstration) -> None:
        """Raise ConfigurationError for a renamed value that is missing in the data set."""
        known = {
            name
            for feature, column in demonstration.columns.items()
            for own in column.names or ()
            for name in (own, f"{feature}:{own}")
        }
        for name in self.renamed:
            if name not in known:
                raise ConfigurationError(
                    f"--map names {name!r}, which the data set does not have.",
                    hint=nearest(name, known) or f"It has: {', '.join(sorted(known))}.",
                )

    def _by_channel(self, feature: str, column: Column) -> dict[str, F64]:
        found = {}
        for place, name in enumerate(column.names or ()):
            plain = name
            for suffix in _SUFFIXES:
                plain = plain.removesuffix(suffix)
            channel = self.renamed.get(f"{feature}:{name}", self.renamed.get(name, plain))
            found[channel] = column.values[:, place]
        return found


@dataclass(frozen=True, kw_only=True, slots=True)
class RecordedStates:
    """Measured states by channel.

    Attributes:
        values: float64 (n,) by name of a joint, `GRIPPER`, or coordinate of the TCP.
    """

    values: Mapping[str, F64]

    def stacked(self, names: Sequence[str]) -> F64 | None:
        """These channels in columns, float64 (n, k); None if one of them is missing."""
        if not names or any(name not in self.values for name in names):
            return None
        return np.stack([self.values[name] for name in names], axis=1)

    def openings(self, arm: ArmProfile) -> F64 | None:
        """Opening of an arm's gripper, 0 closed .. 1 open, float64 (n,); None if not recorded."""
        key = f"{arm.name}/{GRIPPER}" if arm.name else GRIPPER
        if key in self.values:
            return self.values[key]
        gripper = arm.gripper
        if gripper is None or gripper.joint not in self.values:
            return None
        return np.array([gripper.to_opening(float(p)) for p in self.values[gripper.joint]])


def parse_renamed(texts: Sequence[str]) -> dict[str, str]:
    """Parse `--map` to a table. Raises ConfigurationError for a text without "="."""
    found = {}
    for text in texts:
        name, equals, channel = text.rpartition("=")
        if not (equals and name and channel):
            raise ConfigurationError(f"{text!r} is not of the form NAME=CHANNEL.")
        found[name] = channel
    return found
