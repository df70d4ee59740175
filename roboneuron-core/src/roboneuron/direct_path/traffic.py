"""ROS entities of direct motion: writers, action clients and measured joints, created on
first use.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from roboneuron.contract import JointSample, joints_from_message
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.peers import NodeDdsGraph, check_server
from roboneuron.errors import InvalidInputError
from roboneuron.ros import topics
from roboneuron.server.motion_gate import ExposedEndpoint

if TYPE_CHECKING:
    from rclpy.action import ActionClient
    from unique_identifier_msgs.msg import UUID

    from roboneuron.direct_path.writer import NewestMessage, TopicWriter
    from roboneuron.ros.link import RosLink

JOINTS_AGE_S = 0.5
"""Maximum age of measurements."""
_POLL_S = 0.01
_SETTLE_S = 0.1
"""Wait after the discovery of an action server: until it has matched this side too, its answer
would be lost.
"""


class Traffic:
    """Keeps the created entities; usable from any thread.

    Attributes:
        link: returns the open link; may block for a second while joining the graph, and raises as
            `Connection.link`.
    """

    def __init__(self, link: Callable[[], RosLink]) -> None:
        self.link = link
        # held while a writer or client is created, so that a topic gets only one
        self._lock = threading.Lock()
        self._writers: dict[tuple[str, str], TopicWriter] = {}
        self._actions: dict[tuple[str, str], ActionClient] = {}
        self._settled: set[str] = set()
        self._joints: dict[str, NewestMessage] = {}

    def known_writer(self, exposed: ExposedEndpoint) -> TopicWriter | None:
        """Return the existing writer, if any; never blocks."""
        return self._writers.get((exposed.topic, exposed.endpoint.type))

    def writer(self, exposed: ExposedEndpoint) -> TopicWriter:
        """Return the writer of a topic; the first time as `link`."""
        if (known := self.known_writer(exposed)) is not None:
            return known
        from roboneuron.direct_path.writer import TopicWriter  # heavy

        link, key = self.link(), (exposed.topic, exposed.endpoint.type)
        with self._lock:
            if key not in self._writers:
                self._writers[key] = TopicWriter(
                    link, load_type(exposed.endpoint.type), exposed.endpoint.type, exposed.topic
                )
            return self._writers[key]

    def is_served(self, exposed: ExposedEndpoint) -> bool:
        """True if the service or action has a server; blocks for a moment for a new action.

        Raises:
            ConfigurationError: as `check_server`.
        """
        self.check_server(exposed)
        link = self.link()
        if exposed.endpoint.kind != "action":
            return link.is_service_ready(load_type(exposed.endpoint.type), exposed.topic)
        from action_msgs.srv import CancelGoal  # heavy

        if not self.action_client(exposed).server_is_ready():
            self._settled.discard(exposed.topic)
            return False
        if exposed.topic not in self._settled:
            # so that it is discovered before it is needed
            link.is_service_ready(CancelGoal, _cancel_name(exposed))
            time.sleep(_SETTLE_S)
            self._settled.add(exposed.topic)
        return True

    def check_server(self, exposed: ExposedEndpoint) -> None:
        """Refuse an incompatible server of a service or action; see `peers.check_server`."""
        endpoint = exposed.endpoint
        graph = NodeDdsGraph(self.link().node)
        check_server(endpoint.kind, exposed.topic, endpoint.type, graph)

    def action_client(self, exposed: ExposedEndpoint) -> ActionClient:
        """Return the rclpy client of an action, valid while the link is open."""
        from rclpy.action import ActionClient  # heavy

        link, key = self.link(), (exposed.topic, exposed.endpoint.type)
        kind, name = load_type(exposed.endpoint.type), exposed.topic
        with self._lock:
            if key not in self._actions:
                self._actions[key] = link.create(
                    "action client", name, kind, lambda node: ActionClient(node, kind, name)
                )
            return self._actions[key]

    def cancel_goal(self, exposed: ExposedEndpoint, goal_id: UUID) -> None:
        """Ask the server of an action to end a goal, by its id, also when the answer to the goal
        was lost.

        Returns at once.
        """
        from action_msgs.msg import GoalInfo  # heavy
        from action_msgs.srv import CancelGoal  # heavy

        request = CancelGoal.Request(goal_info=GoalInfo(goal_id=goal_id))
        self.link().call(CancelGoal, _cancel_name(exposed), request, lambda: None)

    def newest_joints(self, exposed: ExposedEndpoint) -> JointSample | None:
        """Measured joints of the endpoint's robot, None without recent ones; never blocks."""
        watch = self._joints.get(exposed.namespace)
        message = watch.newest(JOINTS_AGE_S) if watch is not None else None
        if message is None:
            return None
        try:
            return joints_from_message(message)
        except InvalidInputError:
            return None

    def joints(self, exposed: ExposedEndpoint, timeout_s: float) -> JointSample | None:
        """Like `newest_joints`, but wait for a recent measurement: on a busy machine states may be
        late.
        """
        link, space = self.link(), exposed.namespace
        from sensor_msgs.msg import JointState  # heavy

        from roboneuron.direct_path.writer import NewestMessage  # heavy

        with self._lock:
            if space not in self._joints:
                self._joints[space] = NewestMessage(
                    link, JointState, f"/{space}/{topics.JOINT_STATES}"
                )
        deadline_s = time.monotonic() + timeout_s
        self._joints[space].open(timeout_s)
        while (joints := self.newest_joints(exposed)) is None and time.monotonic() < deadline_s:
            time.sleep(_POLL_S)
        return joints


def _cancel_name(exposed: ExposedEndpoint) -> str:
    return f"{exposed.topic}/_action/cancel_goal"
