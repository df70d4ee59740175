"""Conversion between LeRobot's values and joint positions, by name: degrees, percent of an opening,
-100..100 of a calibrated range, each with sign and offset. Pure computation.

LeRobot names a value `<motor>.pos`; its unit is a setting of LeRobot's robot and not part of the
value, so units are always declared, never guessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import InvalidInputError, NotReadyError, RobotProfile, UnsafeError, robot_space

F64 = NDArray[np.float64]

SUFFIX = ".pos"
PERCENT = 100.0
_SLACK = 1e-6
"""Tolerance for rounding of values in a bounded unit."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MotorUnit:
    """Conversion of a motor's value to a joint position: position = scale * value + offset.

    Attributes:
        motor: name in LeRobot, without ".pos".
        joint: name of the joint in the robot's profile.
        scale: radians or metres per unit; its sign is that of the motor.
        offset: position at the value 0 [rad or m].
        lowest, highest: bounds of a commanded value; infinite for angles.
    """

    motor: str
    joint: str
    scale: float
    offset: float = 0.0
    lowest: float = -math.inf
    highest: float = math.inf

    @property
    def key(self) -> str:
        """Key among LeRobot's features."""
        return f"{self.motor}{SUFFIX}"


def degrees(motor: str, joint: str, *, sign: float = 1.0, offset_rad: float = 0.0) -> MotorUnit:
    """Degrees from the middle of the calibrated range (`use_degrees` of LeRobot)."""
    return MotorUnit(motor=motor, joint=joint, scale=sign * math.pi / 180.0, offset=offset_rad)


def percent(
    motor: str, joint: str, closed: float, opened: float, *, inverted: bool = False
) -> MotorUnit:
    """Values 0..100 of a gripper between its joint positions `closed` and `opened`.

    Args:
        inverted: 0 is open.
    """
    first, last = (opened, closed) if inverted else (closed, opened)
    return MotorUnit(
        motor=motor,
        joint=joint,
        scale=(last - first) / PERCENT,
        offset=first,
        lowest=0.0,
        highest=PERCENT,
    )


def share_of_range(
    motor: str, joint: str, half_range_rad: float, *, sign: float = 1.0, offset_rad: float = 0.0
) -> MotorUnit:
    """Values -100..100 of a calibrated range with half width `half_range_rad` [rad]."""
    return MotorUnit(
        motor=motor,
        joint=joint,
        scale=sign * half_range_rad / PERCENT,
        offset=offset_rad,
        lowest=-PERCENT,
        highest=PERCENT,
    )


class MotorMap:
    """The motors of one robot, each with its joint.

    Attributes:
        units: conversions in LeRobot's order.
        keys: keys of LeRobot's features.
        joints: names of the joints, in the same order.
    """

    def __init__(self, units: Sequence[MotorUnit]) -> None:
        """Raises InvalidInputError if a motor or a joint is repeated, or a scale is invalid."""
        self.units = tuple(units)
        self.keys = tuple(unit.key for unit in units)
        self.joints = tuple(unit.joint for unit in units)
        for what, names in (("motor", self.keys), ("joint", self.joints)):
            if len(set(names)) != len(names):
                raise InvalidInputError(f"A {what} is repeated among {', '.join(names)}.")
        bad = [u.motor for u in units if not math.isfinite(u.scale + u.offset) or u.scale == 0.0]
        if bad:
            raise InvalidInputError(f"The unit of motor {bad[0]!r} has no finite scale and offset.")

    def positions(self, values: Mapping[str, float]) -> F64:
        """Joint positions [rad or m], float64 (n,), in the order of `joints`, of commanded values.

        Raises:
            InvalidInputError: a value is missing, of an unknown motor, or outside its unit's
                bounds.
            UnsafeError: a value is NaN or infinite.
        """
        self.check_names(values)
        numbers = [float(values[key]) for key in self.keys]
        for unit, value in zip(self.units, numbers, strict=True):
            if not math.isfinite(value):
                raise UnsafeError(f"{unit.key} is {value}; nothing was sent.")
            if not unit.lowest - _SLACK <= value <= unit.highest + _SLACK:
                raise InvalidInputError(
                    f"{unit.key} is {value:g}, expected {unit.lowest:g} .. {unit.highest:g}."
                )
        return self._positions(numbers)

    def measured(self, values: Mapping[str, float]) -> F64:
        """Joint positions of measured values, which may exceed the bounds of their unit.

        Raises:
            InvalidInputError: a value is missing.
            UnsafeError: a value is NaN or infinite.
        """
        absent = [key for key in self.keys if key not in values]
        if absent:
            raise InvalidInputError(f"The robot does not report {', '.join(absent)}.")
        numbers = [float(values[key]) for key in self.keys]
        if not np.isfinite(numbers).all():
            raise UnsafeError(f"The robot reports {dict(zip(self.keys, numbers, strict=True))}.")
        return self._positions(numbers)

    def values(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Values by key for positions by joint [rad or m].

        Raises:
            InvalidInputError: a joint is missing.
        """
        absent = [joint for joint in self.joints if joint not in positions]
        if absent:
            raise InvalidInputError(f"No position of {', '.join(absent)} is known.")
        return {
            unit.key: min(
                max((positions[unit.joint] - unit.offset) / unit.scale, unit.lowest), unit.highest
            )
            for unit in self.units
        }

    def measured_values(self, positions: Mapping[str, float]) -> dict[str, float]:
        """As `values`, of what a robot measures. Raises NotReadyError: a joint, such as a gripper
        that is not connected, is not measured.
        """
        unmeasured = [
            joint for joint in self.joints if not math.isfinite(positions.get(joint, math.nan))
        ]
        if unmeasured:
            raise NotReadyError(
                f"{', '.join(unmeasured)} of the robot is not measured.",
                hint="Is it connected? See `roboneuron status`, robot.",
            )
        return self.values(positions)

    def check_names(self, values: Mapping[str, float]) -> None:
        """Raise InvalidInputError unless there is exactly one value per motor."""
        unknown = [key for key in values if key not in self.keys]
        absent = [key for key in self.keys if key not in values]
        if unknown or absent:
            what = f"{unknown[0]!r} is no motor of it" if unknown else f"{absent[0]!r} is missing"
            raise InvalidInputError(
                f"The values do not fit the robot: {what}; expected {', '.join(self.keys)}."
            )

    def _positions(self, numbers: Sequence[float]) -> F64:
        return np.array(
            [u.scale * value + u.offset for u, value in zip(self.units, numbers, strict=True)]
        )


def motors_of(profile: RobotProfile, *, use_degrees: bool = True) -> MotorMap:
    """LeRobot's names and units for a robot of RoboNeuron: each joint by its own name, in degrees,
    and each gripper as "gripper" or "<arm>_gripper", 0 closed .. 100 open.

    Args:
        profile: profile of the robot.
        use_degrees: False for radians. Prismatic joints are in metres in either case.

    Raises:
        InvalidInputError: the robot has no arm.
    """
    if not profile.arm_joints:
        raise InvalidInputError(f"Robot {profile.name!r} has no arm.")
    slides = _slides(profile)
    units: list[MotorUnit] = []
    for arm in profile.each_arm:
        for joint in arm.joints:
            plain = joint in slides or not use_degrees
            unit = MotorUnit(motor=joint, joint=joint, scale=1.0)
            units.append(unit if plain else degrees(joint, joint))
        if arm.gripper is not None:
            name = f"{arm.name}_gripper" if arm.name else "gripper"
            gripper = arm.gripper
            closed, opened = gripper.closed_position, gripper.open_position
            units.append(percent(name, gripper.joint, closed, opened))
    return MotorMap(units)


def _slides(profile: RobotProfile) -> set[str]:
    """Joints with positions in metres, by their unit in the robot's own space."""
    space = robot_space("joint_position", profile)
    return {channel.name for channel in space.channels if channel.unit == "m"}
