"""Interface of the simulated world to simulation and cameras, independent of the physics engine.

The robot is at the origin, the table top at z = 0, with the cubes on it. The physics, and the
render twin in another process, each build one.
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
        """Set the joint positions [rad, m], in the order of the cell's `joints`, at rest."""
        ...

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """Set the poses of the named cubes, at rest."""
        ...

    def prepare_physics(self, step_s: float, force: Sequence[float]) -> None:
        """Set time step and friction, couple the fingers, and limit the motors, in the order of the
        cell's `joints` [Nm, N].

        The render twin does not need it.
        """
        ...

    def step(self, position: F64, velocity: F64) -> None:
        """Advance by one step with these motor setpoints, in the order of the cell's `joints` [rad,
        m, per s].
        """
        ...

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (n,), in the order of the cell's
        `joints`.
        """
        ...

    def cube_poses(self) -> dict[str, RawPose]:
        """Poses of the cubes' centres, by name."""
        ...

    def T_base_tcp(self, arm: int = 0) -> F64:
        """TCP pose (4, 4) of the arm with this index in the base frame [m]."""
        ...

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """Render the image of a camera on the base or at a TCP: uint8 (height, width, 3) RGB."""
        ...

    def render_depth(
        self, calibration: CameraCalibration, width: int, height: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Render the image likewise, and its depth: float32 (height, width), distance along the
        optical axis [m], NaN where nothing is within 8 m.
        """
        ...

    def close(self) -> None:
        """Release it; may be called twice."""
        ...
