"""The arm's and the gripper's part of a joint message, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from roboneuron.contract import GripperProfile, JointCommand, JointSample
from roboneuron.errors import UnsafeError

F64 = NDArray[np.float64]

_FARTHEST = 1e4
"""No joint is farther than this [rad or m] from zero; numbers beyond it are damage."""


def pick(names: tuple[str, ...], position: F64, wanted: tuple[str, ...]) -> F64:
    """Positions of the `wanted` joints, float64 (n,). Raises UnsafeError unless each is there once and finite."""
    values = np.asarray(position, dtype=np.float64)
    if values.shape != (len(names),) or len(set(names)) != len(names):
        raise UnsafeError(
            f"{len(names)} joints are named, {len(set(names))} different, with positions of shape {values.shape}."
        )
    if names != wanted:
        missing = [name for name in wanted if name not in names]
        if missing:
            raise UnsafeError(f"The joints {list(names)} lack {missing} of the arm.")
        values = values[[names.index(name) for name in wanted]]
    if not (np.abs(values) <= _FARTHEST).all():  # false for NaN
        raise UnsafeError(f"A joint of the arm is at no possible position: {values.tolist()}.")
    return values


def pick_others(
    command: JointCommand, joints: JointSample, arm: tuple[str, ...]
) -> tuple[tuple[str, ...], NDArray[np.float64]]:
    """Names and positions of the finite joints beside the arm's: as commanded, or else as measured."""
    if joints.names == arm and len(command.names) == len(arm):
        return (), np.zeros(0)
    known = dict(zip(joints.names, joints.position.tolist(), strict=False))
    known |= dict(zip(command.names, command.position.tolist(), strict=False))
    kept = {name: value for name, value in known.items() if name not in arm and abs(value) <= _FARTHEST}
    return tuple(kept), np.array(list(kept.values()), dtype=np.float64)


def check_gripper(command: JointCommand, arm: tuple[str, ...], gripper: GripperProfile | None) -> None:
    """Raise UnsafeError for joints that are neither the arm's nor the gripper's, and for openings beyond its travel."""
    if len(command.names) == len(arm) and command.names == arm:
        return
    for name, value in zip(command.names, command.position.tolist(), strict=False):
        if name in arm:
            continue
        if gripper is None or name != gripper.joint:
            raise UnsafeError(f"A command names the joint {name!r}, which is neither the arm's nor the gripper's.")
        low, high = sorted((gripper.closed_position, gripper.open_position))
        slack = 1e-6 * max(1.0, abs(low), abs(high))
        if not low - slack <= value <= high + slack:
            raise UnsafeError(f"The gripper would go to {value:g}, its travel is {low:g} .. {high:g}.")
