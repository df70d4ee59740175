"""Goals of ROS actions: send, follow, cancel; blocking calls for threads of the control plane."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from action_msgs.msg import GoalInfo, GoalStatus
from action_msgs.srv import CancelGoal
from rclpy.action import ActionClient
from unique_identifier_msgs.msg import UUID

if TYPE_CHECKING:
    from roboneuron.ros.link import RosLink

_POLL_S = 0.01
_SETTLE_S = 0.1
"""After the first sight of a server: until it has matched our side too, its answer would be lost."""
STATUS_WORDS = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_CANCELED: "canceled",
    GoalStatus.STATUS_ABORTED: "aborted",
}
"""Words for the ends of a goal. Source: action_msgs/msg/GoalStatus."""


class Goal:
    """A goal that was sent. `accepted` and `outcome` are None until the server answers."""

    def __init__(self, goal_id: UUID, cancel: Callable[[UUID], None]) -> None:
        self._goal_id = goal_id
        self._cancel = cancel
        self._handle: Any = None
        self._changed = threading.Event()
        self._cancel_wanted = False
        self.accepted: bool | None = None
        self.outcome: Any = None

    @property
    def status(self) -> str:
        """How it ended: "succeeded", "canceled", "aborted" or "unknown"; empty before."""
        return "" if self.outcome is None else STATUS_WORDS.get(self.outcome.status, "unknown")

    def wait(self, done: Callable[[], bool], timeout_s: float, check: Callable[[], None]) -> bool:
        """Wait until `done`; `check` is called at least every 10 ms and may raise. False after `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        while not done():
            check()
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0:
                return False
            self._changed.wait(min(_POLL_S, remaining_s))
            self._changed.clear()
        return True

    def cancel(self) -> None:
        """Ask the server to end it, by its id: also when the answer to the goal was lost. Returns at once."""
        self._cancel_wanted = True
        self._cancel(self._goal_id)

    def _on_answer(self, future: Any) -> None:
        handle = future.result()
        self._handle = handle
        self.accepted = bool(handle is not None and handle.accepted)
        if self.accepted:
            handle.get_result_async().add_done_callback(self._on_result)
            if self._cancel_wanted:
                self._cancel(self._goal_id)
        self._changed.set()

    def _on_result(self, future: Any) -> None:
        self.outcome = future.result()
        self._changed.set()


class GoalClient:
    """Sends goals to one action; made on the link's executor."""

    def __init__(self, link: RosLink, action_type: type, name: str) -> None:
        """Args:
        link: an open link.
        action_type: the rosidl class.
        name: absolute name of the action.
        """
        self._link = link
        self._client: Any = link.on_executor(lambda: ActionClient(link.node, action_type, name))
        self._cancel_name = f"{name}/_action/cancel_goal"
        self._settled = False

    def is_ready(self) -> bool:
        """Whether a server has been discovered; blocks for a moment when that is new."""
        ready = bool(self._client.server_is_ready())
        if ready and not self._settled:
            self._link.is_service_ready(CancelGoal, self._cancel_name)
            time.sleep(_SETTLE_S)
        self._settled = ready
        return ready

    def send(self, goal: Any, on_feedback: Callable[[Any], None]) -> Goal:
        """Send a goal; `on_feedback` is called with feedback messages on the executor's thread."""
        goal_id = UUID(uuid=list(uuid.uuid4().bytes))
        sent = Goal(goal_id, self._cancel)
        future = self._client.send_goal_async(
            goal, feedback_callback=lambda message: on_feedback(message.feedback), goal_uuid=goal_id
        )
        future.add_done_callback(sent._on_answer)
        return sent

    def _cancel(self, goal_id: UUID) -> None:
        request = CancelGoal.Request(goal_info=GoalInfo(goal_id=goal_id))
        self._link.call(CancelGoal, self._cancel_name, request, lambda: None)
