"""Highest speed of a TCP during a motion, and distances to the joints' limits."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from roboneuron.contract import F64, JointSample, RobotProfile
from roboneuron.server.host import Host
from roboneuron.sight.inputs import Inputs, pose_of, pose_topic
from roboneuron.tools.arm.absolute import yaw_of
from roboneuron.tools.arm.grip import Grip
from roboneuron.tools.arm.measured import SpeedMeter

__all__ = ["MotionMeter"]
"""Names that other distributions may use."""

_JOINTS_S = 0.5


class MotionMeter:
    """Measures from `open` to `close`."""

    def __init__(self, host: Host, arm: str) -> None:
        """Args:
        host: of the feature.
        arm: name of one of several arms; "" for the only one.
        """
        self._host, self._arm = host, arm
        self._inputs = Inputs(host)
        self._topic = pose_topic(host.config.namespace, arm)
        self._speeds = SpeedMeter()

    def open(self) -> None:
        """Begin. Raises RoboNeuronError if ROS cannot be joined."""
        self._inputs.open(self._topic, "geometry_msgs/msg/PoseStamped", self.note)

    def note(self, message: Any) -> None:
        """Take a measured pose (geometry_msgs/PoseStamped)."""
        pose = pose_of(message)
        if pose is not None:
            self._speeds.note(pose.stamp_ns / 1e9, pose.position_m, time.monotonic())

    @property
    def highest_m_s(self) -> float | None:
        """Highest speed so far [m/s]; None if nothing was measured."""
        highest_m_s = self._speeds.fastest_since(-math.inf)
        return None if highest_m_s is None else round(highest_m_s, 3)

    def end(self, position_m: F64, rotation: F64) -> dict[str, object]:
        """What is measured where the motion ended, as fields of an answer: `position_m`, `yaw_deg`,
        `joint_margin` and `holding`.

        Args:
            position_m, rotation: measured TCP (3,), (3, 3) in the base frame.
        """
        gate, robot = self._host.gate, self._host.config.robot.name
        exposed = next(one for one in gate.exposed if one.robot == robot)
        return {
            "position_m": np.round(position_m, 4).tolist(),
            "yaw_deg": round(float(np.degrees(yaw_of(rotation))), 1),
            "joint_margin": joint_margin(exposed.profile, gate.joints(exposed, _JOINTS_S)),
            "holding": Grip(self._host, gate, exposed, self._arm).holding(),
        }

    def close(self) -> None:
        """End; idempotent."""
        self._inputs.close()


def joint_margin(profile: RobotProfile | None, joints: JointSample | None) -> dict[str, float]:
    """The joint that is nearest to one of its position limits, and the distance [rad or m]; empty
    if it is not known.
    """
    if profile is None or profile.limits is None or joints is None:
        return {}
    here = dict(zip(joints.names, joints.position.tolist(), strict=True))
    margins = {
        name: min(here[name] - lower, upper - here[name])
        for name, lower, upper in zip(
            profile.arm_joints,
            profile.limits.lower.tolist(),
            profile.limits.upper.tolist(),
            strict=True,
        )
        if name in here and np.isfinite([lower, upper]).all()
    }
    nearest = min(margins, key=margins.__getitem__, default="")
    return {nearest: round(margins[nearest], 4)} if nearest else {}
