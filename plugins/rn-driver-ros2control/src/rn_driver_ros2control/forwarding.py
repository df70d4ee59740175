"""The way to a target as single positions, for controllers that do not interpolate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory

from rn_driver_ros2control.link import ControllerReport, MeasuredJoint
from rn_driver_ros2control.sampling import TrajectorySampler

F64 = NDArray[np.float64]
_NEAR = 0.1
"""Largest distance of the last sent position from the measured joint [rad or m] at which the next
way begins there.
"""


class PositionForwarder:
    """Samples trajectories; not for several threads at once.

    Attributes:
        joints: of the controller, in its order.
    """

    def __init__(self, joints: Sequence[str]) -> None:
        self.joints = tuple(joints)
        self._sampler = TrajectorySampler(self.joints)
        self._sent: tuple[F64, F64] | None = None

    def start(
        self, trajectory: JointTrajectory, measured: Mapping[str, MeasuredJoint], now_s: float
    ) -> None:
        """Replace the way: it begins at what was sent last if the joints are near it, otherwise
        where they are.

        Args:
            trajectory: positions by joint, without a stamp.
            measured: all joints of the controller.
            now_s: monotonic time [s].
        """
        here = np.array([measured[name].position for name in self.joints])
        position, velocity = here, np.zeros_like(here)
        if self._sent is not None and np.abs(self._sent[0] - here).max() < _NEAR:
            position, velocity = self._sent
        self._sampler.start(trajectory, now_s, position, velocity)

    def due(self, now_s: float) -> list[float] | None:
        """Positions to send now, in the controller's order; None once the end has been sent: the
        controller keeps its last value.
        """
        sampled, end_s = self._sampler.sample(now_s), self._sampler.end_s
        if sampled is None or end_s is None:
            return None
        self._sent = sampled
        if now_s >= end_s:
            self._sampler.clear()
        values: list[float] = sampled[0].tolist()
        return values

    def report(self, measured: Mapping[str, MeasuredJoint], received_s: float) -> ControllerReport:
        """What was sent last, as a controller would report its reference."""
        here = {name: measured[name].position for name in self.joints if name in measured}
        reference = {name: (place, 0.0) for name, place in here.items()}
        if self._sent is not None:
            rows = zip(self.joints, self._sent[0].tolist(), self._sent[1].tolist(), strict=True)
            reference = {name: (place, speed) for name, place, speed in rows}
        return ControllerReport(
            joints=self.joints,
            reference=reference,
            error={name: reference[name][0] - place for name, place in here.items()},
            speed_scaling=1.0,
            received_s=received_s,
        )
