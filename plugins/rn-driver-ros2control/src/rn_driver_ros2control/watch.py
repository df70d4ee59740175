"""Availability checks of the controller and its joint states, at the start and before every
command.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from rn_driver_ros2control.link import ControllerLink, MeasuredJoint
from rn_driver_ros2control.options import Ros2ControlOptions
from roboneuron import (
    ConfigurationError,
    JointSample,
    NotReadyError,
    RobotProfile,
    RobotState,
    Topics,
    UnsafeError,
)

F64 = NDArray[np.float64]
_MOST_CLOCK_ERROR_NS = 500_000_000
"""Largest plausible difference of a stamp from local ROS time; beyond it the clock differs, and the
time of arrival is used.
"""
_LEAST_CLOSE = 0.1
"""Largest distance of a reference from the measured joint [rad or m] at which a stop may begin from
it.
"""


class ControllerWatch:
    """Checks a link against the options; usable from any thread."""

    def __init__(self, options: Ros2ControlOptions, profile: RobotProfile, topics: Topics) -> None:
        self._options = options
        self._profile = profile
        self._topics = topics
        self._stamp_ns = 0

    def await_states(self, link: ControllerLink) -> None:
        """Wait until every joint of the arm and the controller have reported.

        Raises:
            NotReadyError: not in time; ConfigurationError: the controller moves other joints.
        """
        deadline_s = time.monotonic() + self._options.connect_timeout_s
        while True:
            missing = [name for name in self._profile.arm_joints if name not in link.joints()]
            report = link.report()
            if not missing and (report is not None or not self._options.watch_controller):
                break
            if time.monotonic() > deadline_s:
                if missing:
                    raise NotReadyError(
                        f"{self._options.joint_states} does not tell {', '.join(missing)}."
                    )
                raise NotReadyError(self._inactive(link))
            time.sleep(0.02)
        if report is not None and set(report.joints) != set(self._profile.arm_joints):
            raise ConfigurationError(
                f"{self._options.controller} moves {', '.join(report.joints)}, the profile "
                f"{self._profile.name!r} has "
                f"{', '.join(self._profile.arm_joints)}; choose another controller or robot."
            )

    def check_topics(self) -> None:
        """Refuse two publishers of one robot's joint states: this driver would read what its own
        module repeats.
        """
        if self._topics.publisher_types("joint_states"):
            raise ConfigurationError(
                "Another node already publishes `joint_states` in the robot's namespace.",
                hint="Set [robot] namespace to one that ros2_control does not use; the driver "
                "reads absolute names.",
            )

    def check_fresh(self, joints: Mapping[str, MeasuredJoint]) -> None:
        """Raise NotReadyError if the arm's joint states have ceased."""
        oldest_s = min(
            (joints[n].received_s for n in self._profile.arm_joints if n in joints), default=0.0
        )
        age_s = time.monotonic() - oldest_s
        if age_s > self._options.state_timeout_s:
            raise NotReadyError(
                f"{self._options.joint_states} has been silent for {age_s:.1f} s.",
                hint="Look whether ros2_control and its joint_state_broadcaster run.",
            )

    def check_read(
        self, link: ControllerLink, joints: Mapping[str, MeasuredJoint], fault: str
    ) -> None:
        """As `check_fresh`, but the error includes the other known facts, since no state can be
        read.
        """
        try:
            self.check_fresh(joints)
        except NotReadyError as error:
            known = [
                error.message,
                f"The controller {self._options.controller} {self._heard(link)}.",
            ]
            if fault:
                known.append(f"Its fault: {fault}.")
            raise NotReadyError(" ".join(known), hint=error.hint) from error

    def _heard(self, link: ControllerLink) -> str:
        report = link.report()
        if not link.is_present():
            return "has gone"
        if report is None:
            return "is not watched"
        return f"last reported its state {time.monotonic() - report.received_s:.1f} s ago"

    def check_controller(self, link: ControllerLink) -> None:
        """Raise NotReadyError if the controller is absent or not active."""
        state = self.controller_state(link)
        if state == "absent":
            raise NotReadyError(
                f"The controller {self._options.controller} has gone.",
                hint="Load and activate it: `ros2 control`.",
            )
        if state == "inactive":
            raise NotReadyError(self._inactive(link))

    def controller_state(self, link: ControllerLink) -> str:
        """One of "active", "inactive", "absent", "not watched"."""
        if not link.is_present():
            return "absent"
        is_forward = self._options.controller_type == "forward-position"
        if not self._options.watch_controller or (is_forward and link.listed() is None):
            return "not watched"
        report = link.report()
        is_fresh = (
            report is not None
            and time.monotonic() - report.received_s <= self._options.state_timeout_s
        )
        return "active" if is_fresh else "inactive"

    def state(
        self, link: ControllerLink, measured: Mapping[str, MeasuredJoint], told: Mapping[str, str]
    ) -> RobotState:
        """Last measured state of the arm, with the driver's own facts.

        Raises:
            UnsafeError: a measured value is not finite.
        """
        names, gripper, opening = self._profile.arm_joints, self._profile.gripper, None
        if gripper is not None and gripper.joint in measured:
            names = (*names, gripper.joint)
            opening = gripper.to_opening(measured[gripper.joint].position)
        chosen = [measured[name] for name in names]
        position = np.array([joint.position for joint in chosen])
        velocities = [joint.velocity for joint in chosen]
        velocity = None if None in velocities else np.array(velocities, dtype=np.float64)
        if not np.isfinite(position).all() or (
            velocity is not None and not np.isfinite(velocity).all()
        ):
            raise UnsafeError(f"{self._options.joint_states} tells a value that is not finite.")
        report = link.report()
        error = (
            max((abs(value) for value in report.error.values()), default=0.0)
            if report is not None
            else 0.0
        )
        return RobotState(
            joints=JointSample(
                names=names, position=position, velocity=velocity, stamp_ns=self._stamp(chosen)
            ),
            gripper_open=opening,
            detail={
                "controller": self.controller_state(link),
                "following_error": f"{error:.5f}",
                "speed_scaling": "" if report is None else f"{report.speed_scaling:g}",
                **told,
            },
        )

    def moving_from(self, link: ControllerLink, *, by_reference: bool) -> tuple[F64, F64] | None:
        """Position and velocity (n,) at which a stop begins; None if unknown.

        The controller's reference if requested and close to the arm, otherwise the measured joints.
        After a fault it is always the measured joints, because a blocked arm must not continue to
        press.
        """
        joints, report, names = link.joints(), link.report(), self._profile.arm_joints
        try:
            self.check_fresh(joints)
        except NotReadyError:
            return None
        position = np.array([joints[name].position for name in names])
        velocity = np.array([joints[name].velocity or 0.0 for name in names])
        if report is not None and by_reference and self.controller_state(link) == "active":
            wanted = np.array([report.reference.get(name, (np.nan, 0.0)) for name in names])
            reference = self._profile.kinds.span(names).nearest(position, wanted[:, 0])
            if np.isfinite(wanted).all() and np.abs(reference - position).max() < _LEAST_CLOSE:
                return reference, wanted[:, 1]
        return position, np.where(np.isfinite(velocity), velocity, 0.0)

    def _stamp(self, joints: Sequence[MeasuredJoint]) -> int:
        """Measurement time of the oldest of `joints`, in local ROS time; never before an earlier
        result.
        """
        now_ns, oldest = self._topics.now_ns(), min(joints, key=lambda joint: joint.received_s)
        stamp_ns = oldest.stamp_ns
        if abs(now_ns - stamp_ns) > _MOST_CLOCK_ERROR_NS:
            stamp_ns = now_ns - int((time.monotonic() - oldest.received_s) * 1e9)
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        return self._stamp_ns

    def _inactive(self, link: ControllerLink) -> str:
        name = self._options.controller
        short = name.rpartition("/")[2]
        listed = link.listed()
        if listed is not None and not listed.state:
            return (
                f"{self._options.controller_manager} lists no controller {short!r}; it has "
                f"{', '.join(listed.others) or 'none'}."
            )
        if listed is not None and listed.state != "active":
            off = f"--deactivate {' '.join(listed.claimed_by)} " if listed.claimed_by else ""
            why = f", and its joints are claimed by {', '.join(listed.claimed_by)}" if off else ""
            return (
                f"{name} is {listed.state}, not active{why}: `ros2 control switch_controllers "
                f"{off}--activate {short}`."
            )
        return (
            f"{name} is there but not active, or its process has just died: "
            f"{name}/controller_state is silent. "
            "Look at `ros2 control list_controllers`; activate it: `ros2 control "
            f"switch_controllers --activate {short}`."
        )
