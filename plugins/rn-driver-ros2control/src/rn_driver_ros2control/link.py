"""Interface between the driver and a controller: a small protocol, so that the driver's rules need
no ROS graph.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from roboneuron import joints_from_message

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True)
class MeasuredJoint:
    """Last report of one joint.

    Attributes:
        position: [rad or m].
        velocity: [rad/s or m/s]; None when not reported.
        stamp_ns: stamp of the message, on the publisher's clock; 0 without one.
        received_s: monotonic time of its arrival.
    """

    position: float
    velocity: float | None
    stamp_ns: int
    received_s: float


_LEAST_STEP_S = 0.005
"""Shortest time over which a velocity is computed from positions."""


def measured_joints(
    message: JointState, received_s: float, before: Mapping[str, MeasuredJoint]
) -> dict[str, MeasuredJoint]:
    """The joints of a message, by name. A velocity that is not reported is the difference quotient
    of positions: a stop begins with it.

    Args:
        message: sensor_msgs/JointState.
        received_s: monotonic time of its arrival.
        before: the same joints as reported last.

    Raises:
        InvalidInputError: as `joints_from_message`.
    """
    joints = joints_from_message(message)
    positions = joints.position.tolist()
    speeds = [math.nan] * len(positions) if joints.velocity is None else joints.velocity.tolist()
    return {
        name: MeasuredJoint(
            position=position,
            velocity=_quotient(before.get(name), position, received_s)
            if math.isnan(speed)
            else speed,
            stamp_ns=joints.stamp_ns,
            received_s=received_s,
        )
        for name, position, speed in zip(joints.names, positions, speeds, strict=True)
    }


def _quotient(before: MeasuredJoint | None, position: float, received_s: float) -> float | None:
    """Velocity since the last report [rad/s or m/s]; the last one if that was just now; None before
    the second.
    """
    if before is None:
        return None
    step_s = received_s - before.received_s
    if step_s < _LEAST_STEP_S:
        return before.velocity
    moved = position - before.position
    turns = round(moved / math.tau)  # a continuous joint that is reported within one turn
    return (moved - turns * math.tau) / step_s


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ControllerReport:
    """One `controller_state` message.

    Attributes:
        joints: joints moved by the controller.
        reference: by joint, the present reference (position, velocity); the velocity is 0 if not
            reported.
        error: by joint, reference - measured [rad or m].
        speed_scaling: 1 if the trajectory runs as planned.
        received_s: monotonic time of its arrival.
    """

    joints: tuple[str, ...]
    reference: Mapping[str, tuple[float, float]]
    error: Mapping[str, float]
    speed_scaling: float
    received_s: float


@dataclass(frozen=True, kw_only=True, slots=True)
class ListedController:
    """What the controller manager lists of the controller.

    Attributes:
        state: "active", "inactive", "unconfigured", "finalized"; "" if it is not listed.
        claimed_by: active controllers that have claimed command interfaces that it needs.
        others: the other controllers with their states, such as "b (active)".
        received_s: monotonic time of the answer.
    """

    state: str
    claimed_by: tuple[str, ...]
    others: tuple[str, ...]
    received_s: float


class End(Enum):
    """Result of a goal."""

    SUCCEEDED = "succeeded"
    REJECTED = "rejected"
    UNANSWERED = "unanswered"
    LOST = "lost"
    PATH_TOLERANCE = "path tolerance violated"
    GOAL_TOLERANCE = "goal tolerance violated"
    PREEMPTED = "preempted"
    CANCELLED = "cancelled"
    ABORTED = "aborted"


class GoalObserver(Protocol):
    """Observer of goals; called from the link's thread."""

    def ended(self, goal: int, end: End, text: str) -> None:
        """Handle the end of the goal of that number."""
        ...


class ControllerLink(Protocol):
    """The controller and its topics, connected; every method may be called from any thread."""

    def open(self, observer: GoalObserver) -> None:
        """Join ROS and find everything named in the options. Raises NotReadyError,
        MissingDependencyError.
        """
        ...

    def joints(self) -> Mapping[str, MeasuredJoint]:
        """Every joint reported so far, newest values."""
        ...

    def report(self) -> ControllerReport | None:
        """The newest `controller_state`; None before the first."""
        ...

    def listed(self) -> ListedController | None:
        """The newest answer of the controller manager; None if it is not asked or silent."""
        ...

    def is_present(self) -> bool:
        """True if the controller's topics have a subscriber."""
        ...

    def publish(self, trajectory: JointTrajectory) -> None:
        """Publish on the topic."""
        ...

    def send_goal(self, goal: int, trajectory: JointTrajectory) -> None:
        """Send as an action goal without waiting; `goal` is the caller's number for it.

        The observer is notified of its end, also if it is rejected or not answered in time.
        """
        ...

    def wait_accepted(self, goal: int, timeout_s: float) -> bool:
        """Wait until that goal is accepted; return False if it was rejected or not answered."""
        ...

    def cancel_goals(self) -> None:
        """Cancel the running goals of this link."""
        ...

    def move_gripper(self, position: float) -> None:
        """Send a gripper goal without waiting; it replaces the previous one."""
        ...

    def gripper_note(self) -> str:
        """Result of the newest gripper goal, as text."""
        ...

    def close(self) -> None:
        """Leave ROS; may be called twice."""
        ...
