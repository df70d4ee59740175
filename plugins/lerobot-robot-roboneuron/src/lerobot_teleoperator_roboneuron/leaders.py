"""Source of a leader's motion: joint states on a ROS topic."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from roboneuron import InvalidInputError, joints_from_message
from roboneuron.command import environment

if TYPE_CHECKING:
    from sensor_msgs.msg import JointState

    from roboneuron.command import RosLink


@dataclass(frozen=True, slots=True)
class Led:
    """The last state of a leader.

    Attributes:
        positions: by joint [rad or m]; empty before the first.
        at_s: arrival time [monotonic s]; 0 before the first.
        problem: why the positions cannot be used; empty if they can.
    """

    positions: Mapping[str, float] = field(default_factory=dict)
    at_s: float = 0.0
    problem: str = ""


class TopicLeader:
    """Joint states of a leader arm, a program or another robot. Usable from any thread."""

    def __init__(self, topic: str) -> None:
        """Args:
        topic: absolute name, sensor_msgs/JointState.
        """
        self.name = f"on {topic}"
        self._topic = topic
        self._changed = threading.Condition()
        self._led = Led()
        self._link: RosLink | None = None

    def open(self) -> None:
        """Start listening; does not wait. Raises RoboNeuronError."""
        environment.prepare_environment()
        from sensor_msgs.msg import JointState  # heavy: needs the environment

        from roboneuron.command import RosLink  # likewise

        link = RosLink("lerobot_teleoperator")
        link.open()
        link.follow(JointState, self._topic, self._take)
        self._link = link

    def newest(self, wait_s: float) -> Led:
        """The newest state, or a problem; waits at most `wait_s` [s] for the first one."""
        with self._changed:
            self._changed.wait_for(lambda: self._led.at_s > 0.0, wait_s)
            return self._led

    def close(self) -> None:
        """Stop listening."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _take(self, message: JointState) -> None:
        problem, positions = "", dict[str, float]()
        try:
            joints = joints_from_message(message)
            positions = dict(zip(joints.names, joints.position.tolist(), strict=True))
        except InvalidInputError as error:
            problem = f"A state {self.name} is malformed: {error}"
        with self._changed:
            self._led = Led(positions, time.monotonic(), problem)
            self._changed.notify_all()
