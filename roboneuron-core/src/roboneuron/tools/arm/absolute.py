"""Absolute poses of the TCP, reached in straight parts from where it is measured."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Sequence

import numpy as np

from roboneuron.contract.arrays import F64
from roboneuron.contract.rotation import matrix_from_quaternion, rotvec_from_matrix
from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.tools.arm.ee_move import AXES

__all__ = ["go_to", "wanted_rotation"]
"""Names that other distributions may use."""

_MOST_M, _MOST_RAD = 0.3, 1.2
"""Largest translation and rotation of one straight part."""
_PARTS = 32
THERE_M, _THERE_RAD = 0.004, 0.02
PoseNow = Callable[[], Awaitable[tuple[F64, F64]]]
"""Measures position (3,) [m] and rotation (3, 3) of the TCP in the base frame."""
MovePart = Callable[[dict[str, float]], Awaitable[None]]
"""Makes a move of move_ee, given by `AXES`, and `duration_s` if it is to be slower."""


def top_down(yaw_rad: float) -> F64:
    """Rotation (3, 3) of a hand that points straight down, its x axis at a yaw."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])


def yaw_of(rotation: F64) -> float:
    """Direction of the hand's x axis (of a rotation (3, 3)) about the vertical [rad]."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def wanted_rotation(
    yaw_deg: float | None, quaternion_xyzw: Sequence[float] | None, present: F64
) -> F64:
    """The rotation (3, 3) that a call asks for; without one, pointing down with the present yaw.

    Raises:
        InvalidInputError: it gives both, or a quaternion that is not of unit length.
    """
    if quaternion_xyzw is None:
        return top_down(yaw_of(present) if yaw_deg is None else float(np.radians(yaw_deg)))
    if yaw_deg is not None:
        raise InvalidInputError("Give yaw_deg or quaternion_xyzw, not both.", path="yaw_deg")
    quaternion = np.array(quaternion_xyzw, dtype=np.float64)
    length = float(np.linalg.norm(quaternion))
    if not 0.99 < length < 1.01:
        raise InvalidInputError(
            f"quaternion_xyzw has the length {length:.3f}, expected 1.", path="quaternion_xyzw"
        )
    return matrix_from_quaternion(quaternion / length)


def slowed(part: F64, speed: float, fastest: tuple[float, float]) -> dict[str, float]:
    """Fields of move_ee for a part (6,) at a fraction of the fastest translation [m/s] and rotation
    [rad/s].
    """
    fields = dict(zip(AXES, part.tolist(), strict=True))
    if speed < 1.0:
        far_m, far_rad = float(np.linalg.norm(part[:3])), float(np.linalg.norm(part[3:]))
        shortest_s = max(far_m / fastest[0], far_rad / fastest[1], 0.1)
        fields["duration_s"] = shortest_s / speed
    return fields


async def go_to(
    pose_now: PoseNow,
    move: MovePart,
    position: F64,
    rotation: F64 | None,
    *,
    what: str,
    speed: float = 1.0,
    fastest: tuple[float, float] = (1.0, 1.0),
    check: Callable[[], None] = lambda: None,
) -> float:
    """Move to a pose along straight parts, each computed from the pose measured at its start;
    return the distance that is left [m].

    Args:
        pose_now, move: measure and move.
        position, rotation: target (3,), (3, 3) in the base frame; None keeps the rotation.
        what: the target, for messages.
        speed: fraction of `fastest`, translation [m/s] and rotation [rad/s].
        check: called after each measurement; raises to end the motion.

    Raises:
        NotReadyError: the arm does not get there.
        RoboNeuronError: as `pose_now`, `move` and `check`.
    """
    far_m = np.inf
    for _ in range(_PARTS):
        here, turned = await pose_now()
        check()
        turn = np.zeros(3) if rotation is None else rotvec_from_matrix(rotation @ turned.T)
        left = np.concatenate([position - here, turn])
        far_m, far_rad = float(np.linalg.norm(left[:3])), float(np.linalg.norm(left[3:]))
        if far_m < THERE_M and far_rad < _THERE_RAD:
            return far_m
        share = min(1.0, _MOST_M / max(far_m, 1e-9), _MOST_RAD / max(far_rad, 1e-9))
        await move(slowed(share * left, speed, fastest))
    raise NotReadyError(f"The TCP does not reach {what}; it is {far_m * 1000:.0f} mm away.")
