"""Interface of the simulated world: one base at the origin of a flat floor, facing +x."""

from __future__ import annotations

from typing import Protocol

from rn_robot_bases.drivetrain import JointTargets, JointValues
from rn_simulation.planar_motion import PlanarPose

HINGE_TORQUE_NM = 10.0
START_HEIGHT_M = 0.002


class BaseWorld(Protocol):
    """One base in one physics engine; from one thread only."""

    def step(self, targets: JointTargets) -> None:
        """Drive the motors to `targets` for one physics step; standing wheels are locked."""
        ...

    def joint_positions(self) -> JointValues:
        """Angle of each joint [rad], in the order of `Platform.joints`; wheel angles include full
        turns.
        """
        ...

    def base_pose(self) -> PlanarPose:
        """True pose of the base frame in the world; the heading is within [-pi, pi]."""
        ...

    def close(self) -> None:
        """Release it; may be called twice."""
        ...
