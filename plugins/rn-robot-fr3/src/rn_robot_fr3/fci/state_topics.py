"""Measurements of the control box, on topics of the robot's namespace and as text for `get_status`.

Topic names are those of franka_ros2's franka_robot_state_broadcaster, if it has them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

from rn_robot_fr3.description import BASE_LINK
from rn_robot_fr3.fci.arm import FciState
from rn_robot_fr3.fci.faults import ArmFault
from rn_robot_fr3.limits import ARM_JOINTS
from roboneuron import Topics

F64 = NDArray[np.float64]
MEASURED_JOINTS = "measured_joint_states"
"""`JointState`: position [rad], velocity [rad/s] and effort [Nm] of the seven joints."""
EXTERNAL_TORQUES = "external_joint_torques"
"""`JointState` with effort only [Nm]: filtered torques not explained by the motion."""
EXTERNAL_WRENCH = "external_wrench_in_base_frame"
"""`WrenchStamped` [N, Nm] at the stiffness frame."""
CURRENT_POSE = "current_pose"
"""`PoseStamped` of the end effector configured in Desk, in the base frame."""
ROBOT_STATE = "robot_state"
"""`DiagnosticStatus` with the keys mode, fault, errors and control_success_rate; ERROR with a
fault.
"""
_PERIOD_S = 1.0 / 60.0
_STATE_PERIOD_S = 0.1


def described(measured: FciState, fault: ArmFault | None) -> dict[str, str]:
    """Facts for `get_status`; arrays as JSON in the order of the joints, or x y z."""
    return {
        "mode": measured.mode,
        "fault": f"{fault.code}: {fault.message}" if fault else "",
        "fault_hint": fault.hint if fault else "",
        "errors": ", ".join(measured.errors),
        "control_success_rate": f"{measured.success_rate:.2f}",
        "joints_rad": _listed(measured.position, 4),
        "velocity_rad_s": _listed(measured.velocity, 4),
        "torque_nm": _listed(measured.torque, 1),
        "external_torque_nm": _listed(measured.external_torque, 1),
        "external_wrench": _listed(measured.wrench, 1),
        "tcp_m": _listed(measured.tcp_m, 4),
    }


class StateTopics:
    """Publishes states at 60 Hz, and mode and fault at 10 Hz and on changes; used by one thread."""

    def __init__(self, topics: Topics) -> None:
        self._joints: Callable[[JointState], None] = topics.advertise(MEASURED_JOINTS, JointState)
        self._torques: Callable[[JointState], None] = topics.advertise(EXTERNAL_TORQUES, JointState)
        self._wrench: Callable[[WrenchStamped], None] = topics.advertise(
            EXTERNAL_WRENCH, WrenchStamped
        )
        self._pose: Callable[[PoseStamped], None] = topics.advertise(CURRENT_POSE, PoseStamped)
        self._state: Callable[[DiagnosticStatus], None] = topics.advertise(
            ROBOT_STATE, DiagnosticStatus
        )
        self._sent_s = self._state_s = -1.0
        self._told: Mapping[str, str] = {}

    def publish(self, measured: FciState, fault: ArmFault | None, measured_ns: int) -> None:
        """Publish the topics that are due; `measured_ns` is the ROS time of the measurement
        [ns].
        """
        now_s = time.monotonic()
        if now_s - self._sent_s >= _PERIOD_S:
            self._sent_s = now_s
            self._publish_measured(measured, measured_ns)
        told = {
            "mode": measured.mode,
            "fault": fault.code if fault else "",
            "errors": ", ".join(measured.errors),
        }
        if told != self._told or now_s - self._state_s >= _STATE_PERIOD_S:
            self._told, self._state_s = told, now_s
            values = {**told, "control_success_rate": f"{measured.success_rate:.2f}"}
            self._state(
                DiagnosticStatus(
                    level=DiagnosticStatus.ERROR if fault else DiagnosticStatus.OK,
                    name="fr3",
                    message=fault.message if fault else measured.mode,
                    values=[KeyValue(key=key, value=value) for key, value in values.items()],
                )
            )

    def _publish_measured(self, measured: FciState, measured_ns: int) -> None:
        seconds, nanoseconds = divmod(measured_ns, 10**9)
        header = Header(stamp=Time(sec=seconds, nanosec=nanoseconds), frame_id=BASE_LINK)
        position, velocity, torque = (
            v.tolist() for v in (measured.position, measured.velocity, measured.torque)
        )
        names = list(ARM_JOINTS)
        self._joints(
            JointState(
                header=header, name=names, position=position, velocity=velocity, effort=torque
            )
        )
        self._torques(
            JointState(header=header, name=names, effort=measured.external_torque.tolist())
        )
        wrench = WrenchStamped(header=header)
        wrench.wrench.force, wrench.wrench.torque = (
            _vector(measured.wrench[:3]),
            _vector(measured.wrench[3:]),
        )
        self._wrench(wrench)
        pose = PoseStamped(header=header)
        pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = measured.tcp_m.tolist()
        turn = pose.pose.orientation
        turn.x, turn.y, turn.z, turn.w = measured.tcp_xyzw.tolist()
        self._pose(pose)


def _vector(values: F64) -> Vector3:
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def _listed(values: F64, digits: int) -> str:
    return json.dumps([round(float(value), digits) for value in values])
