"""Joint commands in messages."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from roboneuron.direct_path.fields import nested, type_name_of
from roboneuron.direct_path.message_types import MessageName, RosMessage

JOINT_TYPES: tuple[MessageName[RosMessage], ...] = (
    MessageName("trajectory_msgs/msg/JointTrajectory"),
    MessageName("sensor_msgs/msg/JointState"),
)
"""Messages that can be checked."""
PLANNER_TYPES: tuple[MessageName[RosMessage], ...] = (
    MessageName("moveit_msgs/msg/MotionPlanRequest"),
    MessageName("moveit_msgs/msg/PlanningScene"),
    MessageName("moveit_msgs/msg/RobotState"),
)
"""Messages whose joints describe the robot's present or assumed state, not its target."""


def joint_commands(message: RosMessage) -> Iterator[Any]:
    """Yield the joint commands in a message, goal or request: itself, or nested at any depth. The
    robot state given to a planner is not one.
    """
    for _, found in nested(message, (*JOINT_TYPES, *PLANNER_TYPES)):
        if type_name_of(found) in JOINT_TYPES:
            yield found
