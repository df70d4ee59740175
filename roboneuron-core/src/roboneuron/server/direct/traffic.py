"""The ROS side of the derived tools: writers, goal clients and measured joints, made when they are first needed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from roboneuron.contract import JointSample
from roboneuron.errors import InvalidInputError
from roboneuron.interfaces import ActionInterface
from roboneuron.ros.topics import JOINT_STATES
from roboneuron.server.direct.endpoints import Exposed

if TYPE_CHECKING:
    from roboneuron.ros.goal import GoalClient
    from roboneuron.ros.link import RosLink
    from roboneuron.ros.reader import NewestMessage
    from roboneuron.ros.writer import TopicWriter

JOINTS_AGE_S = 0.5
"""Older measurements are as good as none."""


class Traffic:
    """Keeps what was made; usable from any thread. `link` may block for the second that joining the graph takes."""

    def __init__(self, link: Callable[[], RosLink]) -> None:
        self._link = link
        self._lock = threading.Lock()
        self._writers: dict[tuple[str, str], TopicWriter] = {}
        self._goals: dict[tuple[str, str], GoalClient] = {}
        self._joints: dict[str, NewestMessage] = {}

    def link(self) -> RosLink:
        """The open link; raises as `Connection.link`."""
        return self._link()

    def known_writer(self, exposed: Exposed) -> TopicWriter | None:
        """The writer if there is one; never blocks."""
        return self._writers.get((exposed.topic, exposed.endpoint.type))

    def writer(self, exposed: Exposed) -> TopicWriter:
        """The writer of a topic."""
        from roboneuron.ros.writer import TopicWriter  # heavy

        link, key = self.link(), (exposed.topic, exposed.endpoint.type)
        with self._lock:
            if key not in self._writers:
                self._writers[key] = TopicWriter(link, exposed.message.ros_type, exposed.endpoint.type, exposed.topic)
            return self._writers[key]

    def goal_client(self, exposed: Exposed) -> GoalClient:
        """The client of an action."""
        from roboneuron.ros.goal import GoalClient  # heavy

        assert isinstance(exposed.interface, ActionInterface)
        link, key = self.link(), (exposed.topic, exposed.endpoint.type)
        with self._lock:
            if key not in self._goals:
                self._goals[key] = GoalClient(link, exposed.interface.ros_type, exposed.topic)
            return self._goals[key]

    def newest_joints(self, exposed: Exposed) -> JointSample | None:
        """The measured joints of the endpoint's robot, None when there are no recent ones; never blocks."""
        watch = self._joints.get(exposed.namespace)
        message = watch.newest(JOINTS_AGE_S) if watch is not None else None
        if message is None:
            return None
        from roboneuron.ros.messages import joints_from_message  # heavy

        try:
            return joints_from_message(message)
        except InvalidInputError:
            return None

    def joints(self, exposed: Exposed, timeout_s: float) -> JointSample | None:
        """Like `newest_joints`, and waits for a first measurement."""
        from sensor_msgs.msg import JointState  # heavy

        from roboneuron.ros.reader import NewestMessage  # heavy

        link = self.link()
        with self._lock:
            if exposed.namespace not in self._joints:
                self._joints[exposed.namespace] = NewestMessage(
                    link, JointState, f"/{exposed.namespace}/{JOINT_STATES}"
                )
            watch = self._joints[exposed.namespace]
        watch.open(timeout_s)
        return self.newest_joints(exposed)

    def forget(self) -> None:
        """Drop everything without touching ROS; the link is about to close."""
        self._writers, self._goals, self._joints = {}, {}, {}
