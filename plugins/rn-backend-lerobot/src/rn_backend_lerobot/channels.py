"""Mapping of a policy's numbers to the robot by name: units, signs and offsets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    ACTION_FIELDS,
    GRIPPER,
    Channel,
    ConfigurationError,
    Observation,
    Pose,
    UngroundedError,
    matrix_from_quaternion,
    rotvec_from_matrix,
)

F64 = NDArray[np.float64]
Unit = Literal[
    "radians",
    "degrees",
    "metres",
    "millimetres",
    "unitless",
    "open_fraction",
    "closed_fraction",
    "open_percent",
    "closed_percent",
    "range_m100_100",
    "range_0_100",
]
_TURN: dict[str, tuple[str, float]] = {
    "radians": ("rad", 1.0),
    "degrees": ("rad", math.pi / 180.0),
    "metres": ("m", 1.0),
    "millimetres": ("m", 1e-3),
    "unitless": ("1", 1.0),
}
"""Contract unit, and the factor that converts one unit to it."""
_OPENINGS: dict[str, tuple[float, float]] = {
    "open_fraction": (1.0, 0.0),
    "closed_fraction": (-1.0, 1.0),
    "open_percent": (0.01, 0.0),
    "closed_percent": (-0.01, 1.0),
}
"""Opening = factor * number + constant."""
_RANGES: dict[str, tuple[float, float]] = {
    "range_m100_100": (-100.0, 100.0),
    "range_0_100": (0.0, 100.0),
}
"""Ends of the ranges to which LeRobot's calibration scales a motor's travel."""
_POSE_UNITS = {
    **dict.fromkeys("xyz", "m"),
    **dict.fromkeys(("qx", "qy", "qz", "qw"), "1"),
    **dict.fromkeys(("rx", "ry", "rz"), "rad"),
}
"""Coordinates of the TCP that a state may contain: position, quaternion, rotation vector, in the
base frame.
"""
_DELTA_UNITS = dict(zip(ACTION_FIELDS[:6], ("m",) * 3 + ("rad",) * 3, strict=True))


@dataclass(frozen=True, kw_only=True, slots=True)
class Meaning:
    """Meaning of one number of a policy on the robot.

    Attributes:
        name: the policy's name for it.
        to: joint, `GRIPPER` or coordinate of the TCP; "arm/..." on a robot with several arms.
        unit: unit of the policy's number.
        sign, offset, scale: robot = sign * scale * (number - offset) [unit].
        low, high: the robot's values at the ends of a range [rad, or opening].
    """

    name: str
    to: str
    unit: Unit
    sign: int = 1
    offset: float = 0.0
    scale: float = 1.0
    low: float | None = None
    high: float | None = None

    @property
    def arm(self) -> str:
        """Name of the arm; "" on a robot with one arm."""
        return self.to.rpartition("/")[0]

    @property
    def target(self) -> str:
        """`to` without the arm."""
        return self.to.rpartition("/")[2]

    @property
    def line(self) -> tuple[float, float]:
        """(factor, constant): robot = factor * number + constant, in the contract's unit."""
        if self.low is not None and self.high is not None:
            first, last = _RANGES[self.unit]
            factor = (self.high - self.low) / (last - first)
            return factor, self.low - factor * first
        if self.unit in _OPENINGS:
            each, closed = _OPENINGS[self.unit]
            factor = each * self.sign * self.scale
            return factor, closed - factor * self.offset
        factor = _TURN[self.unit][1] * self.sign * self.scale
        return factor, -factor * self.offset

    def channel(self, kind: str) -> Channel:
        """The number as a channel of a space of that kind.

        Raises:
            ConfigurationError: the space has no such coordinate, or the unit does not fit it.
        """
        coordinates = {"ee_pose": _POSE_UNITS, "ee_delta": _DELTA_UNITS}.get(kind)
        if self.target == GRIPPER:
            wanted, got = "opening", self._opening_unit()
        elif coordinates is None:
            got = "rad" if self.unit in _RANGES else _TURN.get(self.unit, ("opening",))[0]
            wanted = got if got in ("rad", "m") else "rad"
        elif self.target in coordinates:
            wanted = coordinates[self.target]
            got = _TURN.get(self.unit, ("opening",))[0]
        else:
            raise ConfigurationError(
                f"The number {self.name!r} is mapped to {self.to!r}, which {kind} does not have; "
                f"it has {', '.join(coordinates)} and {GRIPPER}."
            )
        if got != wanted:
            raise ConfigurationError(
                f"The number {self.name!r} has the unit {self.unit!r}, but {self.to!r} is counted "
                f"in {wanted!r}."
            )
        is_joint = self.target != GRIPPER and coordinates is None
        unit = f"{wanted}/s" if is_joint and kind == "joint_velocity" else wanted
        frame = "base" if coordinates is not None and self.target != GRIPPER else ""
        return Channel(name=self.target, unit=unit, frame=frame, arm=self.arm)

    def _opening_unit(self) -> str:
        return "opening" if self.unit in _OPENINGS or self.unit in _RANGES else self.unit

    def read(self, observation: Observation) -> float:
        """The measured value on the robot, in the contract's unit.

        Raises:
            UngroundedError: it is not measured.
        """
        value: float | None = None
        if self.target == GRIPPER:
            state = observation.arms.get(self.arm)
            value = observation.gripper_open if state is None else state.gripper_open
        elif self.target in _POSE_UNITS:
            arm = observation.arms.get(self.arm)
            pose = observation.ee_pose if arm is None else arm.ee_pose
            value = None if pose is None else _of_pose(pose, self.target)
        elif observation.joints is not None and self.target in observation.joints.names:
            place = observation.joints.names.index(self.target)
            value = float(observation.joints.position[place])
        if value is None or not math.isfinite(value):
            raise UngroundedError(
                f"The observation has no finite {self.to!r}, which the policy's state needs as "
                f"{self.name!r}."
            )
        return value


def _of_pose(pose: Pose, target: str) -> float:
    if target in "xyz":
        return float(pose.position_m["xyz".index(target)])
    if target[0] == "q":
        return float(pose.quaternion_xyzw["xyzw".index(target[1])])
    rotation = rotvec_from_matrix(matrix_from_quaternion(pose.quaternion_xyzw))
    return float(rotation["xyz".index(target[1])])


class Columns:
    """The numbers of an action or a state, in the policy's order.

    Args:
        meanings: meaning of each number.
    """

    def __init__(self, meanings: Sequence[Meaning]) -> None:
        self.meanings = tuple(meanings)
        lines = np.array([meaning.line for meaning in meanings], dtype=np.float64).reshape(-1, 2)
        self._factors, self._constants = lines[:, 0], lines[:, 1]
        self._grippers = np.array([m.target == GRIPPER for m in meanings], dtype=bool)

    def to_contract(self, rows: F64) -> F64:
        """Convert the policy's un-normalised rows (H, n) to the contract's units; openings are
        clipped to
        0..1.
        """
        out = rows * self._factors + self._constants
        out[:, self._grippers] = np.clip(out[:, self._grippers], 0.0, 1.0)
        return out

    def read(self, observation: Observation) -> NDArray[np.float32]:
        """The measured state (n,) in the policy's units.

        Raises:
            UngroundedError: a number is not measured, or not finite.
        """
        values = np.array([meaning.read(observation) for meaning in self.meanings])
        return ((values - self._constants) / self._factors).astype(np.float32)
