"""Joint commands that take time: how long, and what ends them when they may not go on."""

from __future__ import annotations

from typing import Any

import numpy as np

from roboneuron.contract import JointCommand, JointSample

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
JOINT_STATE = "sensor_msgs/msg/JointState"
_HOLD_S = 0.1
"""Time that a trajectory gets to bring the joints to where they were measured."""


def duration_s(trajectory: Any) -> float:
    """When the last point of a JointTrajectory is reached, in seconds after it was sent."""
    if not trajectory.points:
        return 0.0
    last = trajectory.points[-1].time_from_start
    return float(last.sec + last.nanosec * 1e-9)


def is_velocity(message: Any) -> bool:
    """Whether a joint command is a JointState of velocities only, which a robot follows until it gets another one."""
    return hasattr(message, "velocity") and bool(len(message.velocity)) and not len(message.position)


def standstill(message: Any) -> Any:
    """The JointState that ends one of velocities: the same joints at zero."""
    return type(message)(name=list(message.name), velocity=[0.0] * len(message.name))


def hold(message: Any, joints: JointSample | None) -> Any:
    """What keeps the joints of a command where they were measured; None when one of them was not."""
    if is_velocity(message):
        return standstill(message)
    names = list(message.joint_names if hasattr(message, "points") else message.name)
    if joints is None or not names or any(name not in joints.names for name in names):
        return None
    position = [float(joints.position[joints.names.index(name)]) for name in names]
    if not hasattr(message, "points"):
        return type(message)(name=names, position=position)
    from roboneuron.ros.messages import to_joint_trajectory  # heavy

    command = JointCommand(names=tuple(names), position=np.array(position), duration_s=_HOLD_S)
    return to_joint_trajectory(command)
