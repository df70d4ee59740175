"""What a row of a lead, or a corrected action, makes the arm do: the displacement of its TCP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rn_standard.teleoperation.samples import F64
from roboneuron import (
    JointCommand,
    JointSample,
    Pose,
    UnsafeError,
    matrix_from_quaternion,
    rotvec_from_matrix,
)


@dataclass(kw_only=True, slots=True)
class Executed:
    """From where the arm is sent on, and what was sent, after the limits. Used from one thread.

    Attributes:
        poses: TCP pose of each arm for a posture; raises UnsafeError.
        start: joints from which the newest row counts; None before it was worked out.
        command: that was sent for it; None when nothing was, or a hold.
    """

    poses: Callable[[JointSample], tuple[Pose, ...]]
    start: JointSample | None = None
    command: JointCommand | None = None

    def begin(self) -> None:
        """Another row is about to be worked out."""
        self.start = self.command = None

    def displacement(self) -> tuple[float, ...]:
        """Of the TCP in the base: x y z [m], rotation vector [rad]; zeros where nothing was sent,
        empty where it cannot be told, as for several arms.
        """
        if self.start is None or self.command is None:
            return (0.0,) * 6
        found = dict(zip(self.start.names, self.start.position.tolist(), strict=True))
        found.update(zip(self.command.names, self.command.position.tolist(), strict=True))
        end = JointSample(names=tuple(found), position=np.array(list(found.values())), stamp_ns=0)
        try:
            before, after = self.poses(self.start), self.poses(end)
        except UnsafeError:
            return ()
        return tuple(displacement(before[0], after[0]).tolist()) if len(after) == 1 else ()


def displacement(start: Pose, end: Pose) -> F64:
    """From one pose to another, float64 (6,): x y z [m], rotation vector [rad], in their frame, so
    that `p' = p + d` and `R' = exp(r) R`.
    """
    before = matrix_from_quaternion(start.quaternion_xyzw)
    after = matrix_from_quaternion(end.quaternion_xyzw)
    turn = rotvec_from_matrix(after @ before.T)
    return np.concatenate([end.position_m - start.position_m, turn])
