"""What the controller manager lists, asked twice a second."""

from __future__ import annotations

import importlib
import time
from collections.abc import Sequence
from typing import Any, Protocol

from rclpy.node import Node
from rclpy.task import Future

from rn_driver_ros2control.link import ListedController
from rn_driver_ros2control.options import Ros2ControlOptions

_TYPES = "controller_manager_msgs"
"""Package of the services. The ROS wheels lack it, and its messages differ from version to version,
so that only the one that is installed beside the controller manager is used.
"""
_PERIOD_S = 0.5


class ControllerState(Protocol):
    """controller_manager_msgs/ControllerState."""

    name: str
    state: str
    claimed_interfaces: Sequence[str]
    required_command_interfaces: Sequence[str]


def listing(
    controllers: Sequence[ControllerState], name: str, received_s: float
) -> ListedController:
    """What the manager's answer says of the controller called `name`."""
    mine = next((one for one in controllers if one.name == name), None)
    needed = set() if mine is None else set(mine.required_command_interfaces)
    others = [one for one in controllers if one.name != name]
    return ListedController(
        state="" if mine is None else mine.state,
        claimed_by=tuple(
            one.name
            for one in others
            if one.state == "active" and needed & set(one.claimed_interfaces)
        ),
        others=tuple(f"{one.name} ({one.state})" for one in others),
        received_s=received_s,
    )


class ManagerWatch:
    """Asks the controller manager on the node's executor.

    Attributes:
        listed: the newest answer; None before the first, without the types, or without a manager.
    """

    def __init__(self, options: Ros2ControlOptions) -> None:
        self.listed: ListedController | None = None
        self._options = options
        self._asked: Future | None = None
        self._client: Any = None

    def join(self, node: Node) -> None:
        """Begin to ask, where the types are installed."""
        try:
            services = importlib.import_module(f"{_TYPES}.srv")
        except ModuleNotFoundError:
            return
        name = f"{self._options.controller_manager}/list_controllers"
        self._client = node.create_client(services.ListControllers, name)
        self._request = services.ListControllers.Request
        node.create_timer(_PERIOD_S, self._ask)

    def _ask(self) -> None:
        if not self._client.service_is_ready():
            self.listed = None
            return
        if self._asked is None or self._asked.done():
            self._asked = self._client.call_async(self._request())
            self._asked.add_done_callback(self._on_answer)

    def _on_answer(self, done: Future) -> None:
        name = self._options.controller.rpartition("/")[2]
        self.listed = listing(done.result().controller, name, time.monotonic())
