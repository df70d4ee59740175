"""Wiring faults to seed into a policy, each with the kind that it should be named by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from policy_world import (
    MARGIN,
    RATE_HZ,
    STATE_JOINTS,
    STATE_POSES,
    Asked,
    Fault,
    actions,
)

from roboneuron import matrix_from_quaternion, matrix_from_rotvec

F64 = NDArray[np.float64]
PER_DEGREE = 180.0 / np.pi


@dataclass(frozen=True)
class Seeded:
    """A fault, and what it is.

    Attributes:
        kind: of the space.
        named: kind of fault that a check should name.
        channels: numbers of the channels that it should name; None: whichever.
        step_s: period that the backend declares.
        unit: of the recorded joints.
    """

    kind: str
    named: str
    fault: Fault | None
    channels: tuple[int, ...] | None = None
    step_s: float = 1.0 / RATE_HZ
    unit: str = "rad"


def affine(
    channels: Sequence[int], scale: float | Sequence[float] = 1.0, offset: object = 0.0
) -> Fault:
    """`scale * x + offset` in these channels."""

    def fault(asked: Asked) -> F64:
        rows = asked.rows()
        rows[:, channels] = rows[:, channels] * scale + np.asarray(offset)
        return rows

    return fault


def ordered(order: Sequence[int]) -> Fault:
    """Channel c has the values of channel order[c]."""
    return lambda asked: asked.rows()[:, [*order, *range(len(order), asked.error.shape[1])]]


def inverted(asked: Asked) -> F64:
    """The gripper's opening counted from the other end."""
    rows = asked.rows()
    rows[:, -1] = 1.0 - rows[:, -1]
    return rows


def motion(change: Callable[[F64, Asked], F64]) -> Fault:
    """Change everything but the gripper."""

    def fault(asked: Asked) -> F64:
        rows = asked.rows()
        rows[:, :-1] = change(rows[:, :-1], asked)
        return rows

    return fault


def turned(rotation: Callable[[Asked], F64]) -> Fault:
    """Displacements in another frame."""

    def change(rows: F64, asked: Asked) -> F64:
        turn = rotation(asked)
        return np.hstack([rows[:, :3] @ turn.T, rows[:, 3:] @ turn.T])

    return motion(change)


def shifted(rows: int) -> Fault:
    """The rows that belong so many rows later."""
    return lambda asked: asked.rows(rows)


def stretched(step: float, scale: float = 1.0) -> Fault:
    """Rows of another rate; displacements grow with the period."""

    def fault(asked: Asked) -> F64:
        rows = asked.rows(0.0, step)
        rows[:, :-1] *= scale
        return rows

    return fault


def to_tcp(asked: Asked) -> F64:
    """From the base into the frame of the TCP."""
    return matrix_from_quaternion(STATE_POSES[asked.row, 3:]).T


def about(axis: Sequence[float], degrees: float) -> Callable[[Asked], F64]:
    """A fixed rotation."""
    turn = matrix_from_rotvec(np.radians(degrees) * np.asarray(axis))
    return lambda asked: turn


def positions_of_tcp(rows: F64, asked: Asked) -> F64:
    """Where the TCP goes, instead of how far."""
    sums = np.cumsum(rows, axis=0)
    sums[:, :3] += STATE_POSES[asked.row, :3]
    return sums


def positions_of_joints(rows: F64, asked: Asked) -> F64:
    """Joint positions instead of velocities."""
    whole = actions("joint_position")[MARGIN + asked.row :][: len(rows), :-1]
    return whole + 0.02 * (rows - rows.mean(axis=0))


ARM = tuple(range(7))
SCALES = (0.4, 1.9, 0.5, 2.4, 0.35, 1.8, 2.1)
OFFSETS = (0.4, -0.3, 0.25, 0.5, -0.35, 0.3, -0.5)


def statistics(count: int, unit: float) -> Fault:
    """Un-normalised by the statistics of another data set."""
    return affine(tuple(range(count)), np.array(SCALES[:count]), unit * np.array(OFFSETS[:count]))


FAULTS: dict[str, Seeded] = {
    # TCP displacements: 0..2 [m], 3..5 [rad], 6 the gripper
    "delta-swap-x-y": Seeded("ee_delta", "swapped", ordered([1, 0, 2]), (0, 1)),
    "delta-swap-rx-rz": Seeded("ee_delta", "swapped", ordered([0, 1, 2, 5, 4, 3]), (3, 5)),
    "delta-rotation-first": Seeded("ee_delta", "swapped", ordered([3, 4, 5, 0, 1, 2])),
    "delta-cycle": Seeded("ee_delta", "swapped", ordered([1, 2, 0]), (0, 1, 2)),
    "delta-degrees": Seeded("ee_delta", "degrees", affine((3, 4, 5), PER_DEGREE), (3, 4, 5)),
    "delta-sign-y": Seeded("ee_delta", "sign", affine((1,), -1.0), (1,)),
    "delta-sign-rz": Seeded("ee_delta", "sign", affine((5,), -1.0), (5,)),
    "delta-millimetres": Seeded("ee_delta", "scale", affine((0, 1, 2), 1000.0), (0, 1, 2)),
    "delta-half": Seeded("ee_delta", "scale", affine((2,), 0.5), (2,)),
    "delta-offset-z": Seeded("ee_delta", "offset", affine((2,), 1.0, 0.02), (2,)),
    "delta-gripper": Seeded("ee_delta", "gripper", inverted, (6,)),
    "delta-statistics": Seeded("ee_delta", "statistics", statistics(6, 0.02)),
    "delta-tcp-frame": Seeded("ee_delta", "frame", turned(to_tcp)),
    "delta-frame-z-90": Seeded("ee_delta", "frame", turned(about((0, 0, 1), 90.0))),
    "delta-frame-x-180": Seeded("ee_delta", "frame", turned(about((1, 0, 0), 180.0))),
    "delta-from-start": Seeded(
        "ee_delta", "relative_to_start", motion(lambda rows, asked: np.cumsum(rows, axis=0))
    ),
    "delta-absolute": Seeded("ee_delta", "absolute_for_relative", motion(positions_of_tcp)),
    "delta-rate-double": Seeded("ee_delta", "rate", stretched(2.0, 2.0)),
    "delta-shift-3": Seeded("ee_delta", "shifted", shifted(3)),
    "delta-shift-minus-2": Seeded("ee_delta", "shifted", shifted(-2)),
    # joint positions
    "position-swap-1-2": Seeded("joint_position", "swapped", ordered([1, 0]), (0, 1)),
    "position-swap-6-7": Seeded(
        "joint_position", "swapped", ordered([0, 1, 2, 3, 4, 6, 5]), (5, 6)
    ),
    "position-reversed": Seeded("joint_position", "swapped", ordered([6, 5, 4, 3, 2, 1, 0])),
    "position-degrees": Seeded("joint_position", "degrees", affine(ARM, PER_DEGREE), ARM),
    "position-recorded-in-degrees": Seeded("joint_position", "degrees", None, ARM, unit="deg"),
    "position-sign-3": Seeded("joint_position", "sign", affine((2,), -1.0), (2,)),
    "position-signs": Seeded("joint_position", "sign", affine((1, 3, 5), -1.0), (1, 3, 5)),
    "position-offset-4": Seeded("joint_position", "offset", affine((3,), 1.0, 0.2), (3,)),
    "position-offset-quarter": Seeded(
        "joint_position", "offset", affine((6,), 1.0, np.pi / 2), (6,)
    ),
    "position-gripper": Seeded("joint_position", "gripper", inverted, (7,)),
    "position-statistics": Seeded("joint_position", "statistics", statistics(7, 1.0)),
    "position-relative": Seeded(
        "joint_position",
        "relative_for_absolute",
        motion(lambda rows, asked: rows - STATE_JOINTS[asked.row]),
    ),
    "position-added-twice": Seeded(
        "joint_position",
        "absolute_for_relative",
        motion(lambda rows, asked: rows + STATE_JOINTS[asked.row]),
    ),
    "position-rate-half": Seeded("joint_position", "rate", stretched(0.5)),
    "position-rate-double": Seeded("joint_position", "rate", stretched(2.0)),
    "position-rate-declared": Seeded("joint_position", "rate", None, step_s=0.05),
    "position-shift-2": Seeded("joint_position", "shifted", shifted(2)),
    "position-shift-minus-5": Seeded("joint_position", "shifted", shifted(-5)),
    # joint velocities
    "velocity-swap-2-5": Seeded(
        "joint_velocity", "swapped", ordered([0, 4, 2, 3, 1, 5, 6]), (1, 4)
    ),
    "velocity-degrees": Seeded("joint_velocity", "degrees", affine(ARM, PER_DEGREE), ARM),
    "velocity-sign-6": Seeded("joint_velocity", "sign", affine((5,), -1.0), (5,)),
    "velocity-scale-4": Seeded("joint_velocity", "scale", affine((3,), 2.5), (3,)),
    "velocity-per-row": Seeded("joint_velocity", "scale", affine(ARM, 1.0 / RATE_HZ), ARM),
    "velocity-offset-1": Seeded("joint_velocity", "offset", affine((0,), 1.0, 0.3), (0,)),
    "velocity-gripper": Seeded("joint_velocity", "gripper", inverted, (7,)),
    "velocity-statistics": Seeded("joint_velocity", "statistics", statistics(7, 0.5)),
    "velocity-positions": Seeded(
        "joint_velocity", "absolute_for_relative", motion(positions_of_joints)
    ),
    "velocity-rate": Seeded("joint_velocity", "rate", stretched(1.5)),
    "velocity-shift-4": Seeded("joint_velocity", "shifted", shifted(4)),
}
