"""A robot on a rail, without a gripper: joints that slide, turn without end, follow another one,
and have end stops. It is moved by a joint_trajectory_controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import DriverSpec, RobotSpec

if TYPE_CHECKING:
    from roboneuron.contract import RobotProfile

PLUGIN = "gantry_plugin"
_KINDS = {
    "rail": ("prismatic", "0 0 0.6", "1 0 0", (0.0, 1.2)),
    "turn": ("continuous", "0 0 0.1", "0 0 1", None),
    "shoulder": ("revolute", "0 0 0.05", "0 1 0", (-1.5, 1.5)),
    "level": ("revolute", "0 0 0.3", "0 1 0", (-1.6, 1.6)),
    "elbow": ("revolute", "0.02 0 0", "0 1 0", (-2.2, 2.2)),
    "roll": ("continuous", "0.25 0 0", "1 0 0", None),
    "pitch": ("revolute", "0.1 0 0", "0 1 0", (-2.0, 2.0)),
    "spin": ("continuous", "0.08 0 0", "1 0 0", None),
}
"""Kind, origin, axis and end stops of each joint; `level` keeps what `shoulder` carries level."""
_BOXES = {
    "rail": ("0 0 -0.1", "0.2 0.2 0.2"),
    "elbow": ("0.12 0 0", "0.12 0.06 0.06"),
    "spin": ("0.04 0 0", "0.06 0.06 0.06"),
}
"""Place and size of the shapes of links [m]."""
FOLLOWER = "level"
JOINTS = tuple(name for name in _KINDS if name != FOLLOWER)
HOME = (0.4, 0.0, 0.3, 0.6, 0.0, 0.5, 0.0)
VELOCITY = (0.5, 2.0, 2.0, 2.0, 3.0, 3.0, 3.0)


def urdf() -> str:
    """A description: one chain, with a box at each long link."""
    parts, parent = ['<robot name="gantry"><link name="floor"/>'], "floor"
    for name, (kind, place, axis, stops) in _KINDS.items():
        bounds = "" if stops is None else f'lower="{stops[0]}" upper="{stops[1]}" '
        follows = '<mimic joint="shoulder" multiplier="-1"/>' if name == FOLLOWER else ""
        shape = ""
        if name in _BOXES:
            place_m, size_m = _BOXES[name]
            shape = (
                f'<collision><origin xyz="{place_m}"/><geometry><box size="{size_m}"/></geometry>'
                "</collision>"
            )
        parts.append(
            f'<link name="{name}_link">{shape}</link><joint name="{name}" type="{kind}">'
            f'<parent link="{parent}"/><child link="{name}_link"/><origin xyz="{place}"/>'
            f'<axis xyz="{axis}"/><limit {bounds}velocity="3" effort="50"/>{follows}</joint>'
        )
        parent = f"{name}_link"
    parts.append(
        f'<link name="tool"/><joint name="mount" type="fixed"><parent link="{parent}"/>'
        '<child link="tool"/><origin xyz="0.1 0 0" rpy="0 1.5707963 0"/></joint></robot>'
    )
    return "".join(parts)


def profile() -> RobotProfile:
    """Facts of the robot."""
    import numpy as np

    from roboneuron.contract import CollisionProfile, Endpoint, JointLimits, RobotProfile

    stops = [_KINDS[name][3] or (-np.inf, np.inf) for name in JOINTS]
    return RobotProfile(
        name="gantry",
        urdf=urdf(),
        base_link="floor",
        tcp_link="tool",
        arm_joints=JOINTS,
        limits=JointLimits(
            lower=np.array([low for low, _ in stops]),
            upper=np.array([high for _, high in stops]),
            velocity=np.array(VELOCITY),
            acceleration=np.full(len(JOINTS), 8.0),
            effort=np.full(len(JOINTS), 50.0),
        ),
        home_rad=np.array(HOME),
        collision=CollisionProfile(min_distance_m=0.01),
        endpoints=(
            Endpoint(
                name="joint_trajectory",
                kind="publish",
                topic="joint_trajectory",
                type="trajectory_msgs/msg/JointTrajectory",
                summary="Move the joints [m and rad].",
                rate_hz=50.0,
                joint_limited=True,
            ),
            Endpoint(
                name="joint_states",
                kind="read",
                topic="joint_states",
                type="sensor_msgs/msg/JointState",
                summary="Measured joint positions [m and rad].",
            ),
        ),
    )


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """The robot."""
    return [
        RobotSpec(
            name="gantry",
            summary="An arm on a rail, without a gripper.",
            target=f"{PLUGIN}:profile",
            robot_kind="arm",
            action_widths=(7,),
            drivers=(
                DriverSpec(
                    name="ros2-control",
                    summary="joint_trajectory_controller of ros2_control",
                    target="rn_driver_ros2control.driver:Ros2ControlDriver",
                    config="rn_driver_ros2control.options:Ros2ControlOptions",
                    recovers=True,
                ),
            ),
        )
    ]
