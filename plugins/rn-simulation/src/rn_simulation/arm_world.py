"""The simulated world as simulation and cameras see it, whichever physics engine builds it.

The robot stands at the origin, the table top is at z = 0, the cubes lie on it. The physics and the
render twin, in another process, each build one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rn_simulation.cubes import RawPose
from rn_simulation.engine import Engine
from roboneuron import CameraCalibration

F64 = NDArray[np.float64]


class ArmWorld(Protocol):
    """Arms, table and cubes in one physics engine; from one thread only."""

    engine: Engine

    def set_joints(self, position: Sequence[float]) -> None:
        """Put the joints, in the order of the cell's `joints`, at `position` [rad, m], at rest."""
        ...

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """Put the named cubes somewhere, at rest."""
        ...

    def prepare_physics(self, step_s: float, force: Sequence[float]) -> None:
        """Set time step and friction, couple the fingers, and limit the motors, in the order of the
        cell's `joints` [Nm, N].

        The render twin does without.
        """
        ...

    def step(self, position: F64, velocity: F64) -> None:
        """Advance by one step, the motors aiming at these, in the order of the cell's `joints`
        [rad, m, per s].
        """
        ...

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (n,), in the order of the cell's
        `joints`.
        """
        ...

    def cube_poses(self) -> dict[str, RawPose]:
        """Where the cubes' centres are, by name."""
        ...

    def T_base_tcp(self, arm: int = 0) -> F64:
        """Pose (4, 4) of the TCP of the arm of that number in the base frame [m]."""
        ...

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """Draw what a camera on the base or at a TCP sees: uint8 (height, width, 3) RGB."""
        ...

    def close(self) -> None:
        """Release it; may be called twice."""
        ...
