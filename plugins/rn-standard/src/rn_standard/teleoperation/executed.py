"""Effect of a lead's row, or of a corrected action, on the arm: the displacement of its TCP."""

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
    """Start and result of a command, after the limits. Used from one thread.

    Attributes:
        poses: TCP pose of each arm for a posture; raises UnsafeError.
        start: joints to which the newest row is relative; None before its computation.
        command: the command sent for it; None if nothing or a hold was sent.
    """

    poses: Callable[[JointSample], tuple[Pose, ...]]
    start: JointSample | None = None
    command: JointCommand | None = None

    def begin(self) -> None:
        """Reset before the computation of another row."""
        self.start = self.command = None

    def displacement(self) -> tuple[float, ...]:
        """Displacement of the TCP in the base: x y z [m], rotation vector [rad]; zeros if nothing
        was sent, empty if unknown, as for several arms.
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
    """Displacement between two poses, float64 (6,): x y z [m], rotation vector [rad], in their
    frame, so that `p' = p + d` and `R' = exp(r) R`.
    """
    before = matrix_from_quaternion(start.quaternion_xyzw)
    after = matrix_from_quaternion(end.quaternion_xyzw)
    turn = rotvec_from_matrix(after @ before.T)
    return np.concatenate([end.position_m - start.position_m, turn])
