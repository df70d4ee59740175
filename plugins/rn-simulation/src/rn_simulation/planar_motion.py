"""Motion of a base on a flat floor, and dead reckoning: its pose integrated from wheel encoders,
which drifts as on a real base.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

from nav_msgs.msg import Odometry

ODOM_FRAME = "odom"
"""Frame of the pose: that of the base at its start."""
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, kw_only=True, slots=True)
class BaseVelocity:
    """Velocity of a base in its own frame.

    Attributes:
        linear_x, linear_y: forwards and to the left [m/s].
        angular_z: counter-clockwise [rad/s].
    """

    linear_x: float
    linear_y: float
    angular_z: float


@dataclass(frozen=True, kw_only=True, slots=True)
class PlanarPose:
    """Position [m] and heading [rad, counter-clockwise, not wrapped] on the floor."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0

    def described(self) -> str:
        """JSON: x_m, y_m, yaw_rad."""
        rounded = {
            "x_m": round(self.x_m, 4),
            "y_m": round(self.y_m, 4),
            "yaw_rad": round(self.yaw_rad, 4),
        }
        return json.dumps(rounded, separators=(",", ":"))


def integrate(pose: PlanarPose, velocity: BaseVelocity, step_s: float) -> PlanarPose:
    """The pose after `step_s` at `velocity`, with the heading in the middle of the step (second
    order).
    """
    turn = velocity.angular_z * step_s
    heading = pose.yaw_rad + turn / 2.0
    forwards, leftwards = velocity.linear_x * step_s, velocity.linear_y * step_s
    return PlanarPose(
        x_m=pose.x_m + math.cos(heading) * forwards - math.sin(heading) * leftwards,
        y_m=pose.y_m + math.sin(heading) * forwards + math.cos(heading) * leftwards,
        yaw_rad=pose.yaw_rad + turn,
    )


def to_message(
    pose: PlanarPose, velocity: BaseVelocity, *, stamp_ns: int, base_link: str
) -> Odometry:
    """nav_msgs/Odometry: pose in `odom`, twist in the base frame; covariances are zero, because
    they are not estimated.
    """
    message = Odometry(child_frame_id=base_link)
    message.header.frame_id = ODOM_FRAME
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(stamp_ns), _NS_PER_S)
    message.pose.pose.position.x = float(pose.x_m)
    message.pose.pose.position.y = float(pose.y_m)
    message.pose.pose.orientation.z = math.sin(pose.yaw_rad / 2.0)
    message.pose.pose.orientation.w = math.cos(pose.yaw_rad / 2.0)
    message.twist.twist.linear.x = float(velocity.linear_x)
    message.twist.twist.linear.y = float(velocity.linear_y)
    message.twist.twist.angular.z = float(velocity.angular_z)
    return message
