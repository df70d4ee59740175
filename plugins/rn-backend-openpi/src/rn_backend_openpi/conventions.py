"""Conversion of a policy's gripper and rotation conventions to the contract's openings and
matrices, and back; conversion to the units of a network.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rn_vla.normalisation import Scaling
from rn_vla.rotation import F64, matrix_from_rpy, rpy_from_matrix
from roboneuron import (
    ConfigurationError,
    UnsafeError,
    matrix_from_quaternion,
    matrix_from_rotvec,
    rotvec_from_matrix,
)

GripperValue = Literal["open_fraction", "closed_fraction", "signed_open", "signed_close", "none"]
PoseRotation = Literal["quaternion", "quaternion_wxyz", "rotvec", "rpy", "rot6d", "rot6d_rows"]
ROTATION_VALUES: Mapping[str, int] = MappingProxyType(
    {
        "quaternion": 4,
        "quaternion_wxyz": 4,
        "rotvec": 3,
        "rpy": 3,
        "rot6d": 6,
        "rot6d_rows": 6,
    }
)
"""Number of values of each convention."""
_OPENINGS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        "open_fraction": (0.0, 1.0),
        "closed_fraction": (1.0, -1.0),
        "signed_open": (0.5, 0.5),
        "signed_close": (0.5, -0.5),
    }
)
"""Opening at the value 0 of each gripper convention, and its change by a value of 1."""
_SHORTEST = 1e-3
"""Smallest length of a quaternion or an axis that still defines a direction."""


def to_opening(values: F64, convention: GripperValue) -> F64:
    """Convert a policy's gripper values to openings, without clipping."""
    start, step = _OPENINGS[convention]
    return start + step * values


def from_opening(openings: F64, convention: GripperValue) -> F64:
    """The inverse of `to_opening`."""
    start, step = _OPENINGS[convention]
    return (openings - start) / step


def matrix_of(values: F64, rotation: PoseRotation) -> F64:
    """Rotation matrix (3, 3) of a policy's values. Raises UnsafeError if they are no rotation."""
    if rotation == "rotvec":
        return matrix_from_rotvec(values)
    if rotation == "rpy":
        return matrix_from_rpy(values)
    if rotation in ("quaternion", "quaternion_wxyz"):
        xyzw = values if rotation == "quaternion" else np.roll(values, -1)
        return matrix_from_quaternion(xyzw / _length(xyzw, values))
    # Gram-Schmidt: a network's two vectors are only nearly of length 1 and nearly perpendicular
    first = values[:3] / _length(values[:3], values)
    across = values[3:] - first * (first @ values[3:])
    second = across / _length(across, values)
    axes = np.array([first, second, np.cross(first, second)])
    return axes if rotation == "rot6d_rows" else axes.T


def _length(vector: F64, told: F64) -> float:
    length = float(np.linalg.norm(vector))
    if length < _SHORTEST:
        raise UnsafeError(f"The policy server's values {told.tolist()} are no rotation.")
    return length


def rotation_of(quaternion_xyzw: F64, rotation: PoseRotation) -> F64:
    """The inverse of `matrix_of`, for a unit quaternion."""
    if rotation in ("quaternion", "quaternion_wxyz"):
        return np.roll(quaternion_xyzw, int(rotation == "quaternion_wxyz"))
    matrix = matrix_from_quaternion(quaternion_xyzw)
    if rotation == "rotvec":
        return rotvec_from_matrix(matrix)
    if rotation == "rpy":
        return rpy_from_matrix(matrix)
    axes = matrix if rotation == "rot6d_rows" else matrix.T
    return axes[:2].reshape(6)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class NetworkUnits:
    """Conversion for a network that is served without any, as LeRobot checkpoints are by some
    engines.

    Attributes:
        state_key: key of the whole state in a request.
        state, actions: statistics of the training data; None if the server converts.
        width: number of values of a served row, of which the last are padding; None for none.
    """

    state_key: str
    state: Scaling | None = None
    actions: Scaling | None = None
    width: int | None = None

    def to_network(self, state: F64) -> NDArray[np.float32]:
        """Convert a measured state (n,) to the network's units.

        Raises:
            ConfigurationError: the statistics are of fewer values.
        """
        if self.state is None:
            return state.astype(np.float32)
        if self.state.width < len(state):
            raise ConfigurationError(
                f"The statistics of the state are of {self.state.width} values, the profile's "
                f"state has {len(state)}.",
                hint="Name the statistics of the served checkpoint.",
            )
        return self.state.head(len(state)).normalize(state).astype(np.float32)

    def from_network(self, served: F64, width: int) -> F64:
        """Convert served rows (H, m) to rows (H, width) in the profile's units."""
        rows = served[:, :width]
        if self.actions is None:
            return rows
        return self.actions.head(width).denormalize(rows).astype(np.float64)
