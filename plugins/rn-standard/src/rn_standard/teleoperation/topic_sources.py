"""Teleoperators for ROS topics: a twist, and the joints of a leader."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rn_standard.teleoperation.samples import Frame, LeadSample, Subscribe
from roboneuron import InvalidInputError, RobotProfile, joints_from_message

if TYPE_CHECKING:
    from geometry_msgs.msg import TwistStamped
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Bool


class TwistTopicOptions(BaseModel):
    """Options of `twist-topic`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str = Field(
        default="/lead/twist", description="geometry_msgs/TwistStamped; zero releases the switch"
    )
    frame: Literal["base", "tool"] = Field(
        default="base", description="of messages whose frame_id is empty"
    )


class JointTopicOptions(BaseModel):
    """Options of `joint-topic`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str = Field(
        default="/leader/joint_states",
        description="sensor_msgs/JointState, by the names of the robot that follows",
    )
    switch: str = Field(
        default="/leader/switch",
        description="std_msgs/Bool, true while the person holds it, and then repeated",
    )
    switch_s: float = Field(
        default=0.5,
        gt=0,
        le=5,
        description="how long one `true` counts: whoever reads the switch may have ended",
    )


class _Newest:
    """The newest sample, passed from the thread of the ROS node to that of the lead."""

    def __init__(self) -> None:
        self._news = threading.Condition()
        self._sample: LeadSample | None = None
        self._error: InvalidInputError | None = None
        self._number = 0

    def put(self, error: InvalidInputError | None = None, **facts: Any) -> None:
        with self._news:
            self._number += 1
            self._error = error
            if error is None:
                self._sample = LeadSample(number=self._number, at_s=time.monotonic(), **facts)
            self._news.notify_all()

    def take(self, timeout_s: float) -> LeadSample | None:
        with self._news:
            self._news.wait_for(lambda: self._sample is not None or self._error, timeout_s)
            if self._error is not None:
                raise self._error
            sample, self._sample = self._sample, None
            return sample


class TwistTopic:
    """The newest twist of a topic; implements `Teleoperator`. Zero speeds release the switch."""

    def __init__(self, config: TwistTopicOptions | None, profile: RobotProfile) -> None:
        self._options = config or TwistTopicOptions()
        self._base, self._tool = profile.base_link, profile.tcp_link
        self._newest = _Newest()
        self._end: Callable[[], None] | None = None

    def open(self, subscribe: Subscribe) -> None:
        """See `Teleoperator`."""
        from geometry_msgs.msg import TwistStamped  # heavy

        self._end = subscribe(TwistStamped, self._options.topic, self._take)

    def read(self, timeout_s: float) -> LeadSample | None:
        """See `Teleoperator`. Raises InvalidInputError for another frame."""
        return self._newest.take(timeout_s)

    def close(self) -> None:
        """See `Teleoperator`."""
        end, self._end = self._end, None
        if end is not None:
            end()

    def _take(self, message: TwistStamped) -> None:
        frames: dict[str, Frame] = {
            "": self._options.frame,
            self._base: "base",
            self._tool: "tool",
        }
        frame = frames.get(message.header.frame_id)
        if frame is None:
            error = InvalidInputError(
                f"A twist is in the frame {message.header.frame_id!r}; expected {self._base!r} or "
                f"{self._tool!r}."
            )
            self._newest.put(error)
            return
        linear, angular = message.twist.linear, message.twist.angular
        twist = np.array([linear.x, linear.y, linear.z, angular.x, angular.y, angular.z])
        self._newest.put(is_held=bool(twist.any()), twist=twist, frame=frame)


class JointTopic:
    """A second robot, or an arm moved by hand, as leader; implements `Teleoperator`."""

    def __init__(self, config: JointTopicOptions | None, profile: RobotProfile) -> None:
        self._options = config or JointTopicOptions()
        self._arm = frozenset(profile.arm_joints)
        self._gripper = profile.gripper
        self._newest = _Newest()
        self._held_until_s = -math.inf
        self._ends: list[Callable[[], None]] = []

    def open(self, subscribe: Subscribe) -> None:
        """See `Teleoperator`."""
        from sensor_msgs.msg import JointState  # heavy
        from std_msgs.msg import Bool  # heavy

        self._ends.append(subscribe(Bool, self._options.switch, self._press))
        self._ends.append(subscribe(JointState, self._options.topic, self._take))

    def read(self, timeout_s: float) -> LeadSample | None:
        """See `Teleoperator`. Raises InvalidInputError for a message that lacks a joint."""
        return self._newest.take(timeout_s)

    def close(self) -> None:
        """See `Teleoperator`."""
        ends, self._ends = self._ends, []
        for end in ends:
            end()

    def _press(self, message: Bool) -> None:
        self._held_until_s = (
            time.monotonic() + self._options.switch_s if message.data else -math.inf
        )

    def _take(self, message: JointState) -> None:
        try:
            joints = joints_from_message(message)
        except InvalidInputError as error:
            self._newest.put(error)
            return
        found = dict(zip(joints.names, joints.position.tolist(), strict=True))
        absent = sorted(self._arm - set(found))
        if absent:
            told = (
                f"The leader's joints lack {', '.join(absent)}; give them the names of the arm's."
            )
            self._newest.put(InvalidInputError(told))
            return
        gripper, opening = self._gripper, None
        if gripper is not None and gripper.joint in found:
            opening = found[gripper.joint]
            # the lead refuses others, which `to_opening` would make 0 or 1
            if math.isfinite(opening):
                opening = gripper.to_opening(opening)
        positions = {name: found[name] for name in sorted(self._arm)}
        is_held = time.monotonic() < self._held_until_s
        self._newest.put(is_held=is_held, positions=positions, gripper_open=opening)
