"""A forward controller of positions over ROS 2: it takes each value at once, so the way to a target
is sampled here.
"""

from __future__ import annotations

import logging
import time

from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from rn_driver_ros2control.forwarding import PositionForwarder
from rn_driver_ros2control.link import ControllerReport, GoalObserver
from rn_driver_ros2control.options import Ros2ControlOptions
from rn_driver_ros2control.ros_link import RosControllerLink
from roboneuron import ConfigurationError, NotReadyError, StateError

log = logging.getLogger(__name__)
_POSITION = "position"


class RosForwardLink(RosControllerLink):
    """Implements `ControllerLink` for JointGroupPositionController, and ForwardCommandController
    with the interface position.

    Source of names and behaviour: ros2_controllers, forward_command_controller (Jazzy: userdoc.rst,
    parameters): the topic `~/commands` has one value for each of the parameter `joints`, in its
    order.
    """

    def __init__(self, options: Ros2ControlOptions, joints: tuple[str, ...]) -> None:
        """As of the base class."""
        super().__init__(options, joints)
        self._forwarder: PositionForwarder | None = None

    def open(self, observer: GoalObserver) -> None:
        """See `ControllerLink.open`.

        Raises:
            ConfigurationError: it forwards another quantity than positions.
        """
        super().open(observer)
        names, interface = self._ask_parameters()
        if interface not in ("", _POSITION):
            raise ConfigurationError(
                f"{self._options.controller} forwards {interface!r}, expected {_POSITION!r}.",
                hint="Choose a controller of positions.",
            )
        self._forwarder = PositionForwarder(names)

    def _join_controller(self, node: Node) -> None:
        topic = f"{self._options.controller}/commands"
        self._publisher = node.create_publisher(Float64MultiArray, topic, 1)
        service = f"{self._options.controller}/get_parameters"
        self._parameters = node.create_client(GetParameters, service)
        node.create_timer(1.0 / self._options.rate_hz, self._forward)

    def _ask_parameters(self) -> tuple[tuple[str, ...], str]:
        """Its joints in their order, and its interface; "" for one of positions only."""
        self._wait(
            self._parameters.service_is_ready,
            f"{self._options.controller} does not tell its parameters",
        )
        request = GetParameters.Request(names=["joints", "interface_name"])
        answers: list[Future] = []

        def ask() -> None:
            answers.append(self._parameters.call_async(request))

        self._on_executor(ask, log.error)
        self._wait(
            lambda: bool(answers) and answers[0].done(),
            f"{self._options.controller} does not tell its joints",
        )
        values: list[ParameterValue] = answers[0].result().values
        if not values or not values[0].string_array_value:
            raise NotReadyError(f"{self._options.controller} has no parameter `joints`.")
        interface = values[1].string_value if len(values) > 1 else ""
        return tuple(values[0].string_array_value), str(interface)

    def is_present(self) -> bool:
        """See `ControllerLink.is_present`."""
        return int(self._publisher.get_subscription_count()) > 0

    def publish(self, trajectory: JointTrajectory) -> None:
        """See `ControllerLink.publish`."""
        with self._lock:
            if self._context is None or not self._context.ok() or self._forwarder is None:
                raise StateError("The connection to ros2_control is closed.")
            self._forwarder.start(trajectory, self._measured, time.monotonic())

    def _forward(self) -> None:
        with self._lock:
            if self._forwarder is None:
                return
            values = self._forwarder.due(time.monotonic())
            if values is not None and self._context is not None and self._context.ok():
                self._publisher.publish(Float64MultiArray(data=values))

    def report(self) -> ControllerReport | None:
        """See `ControllerLink.report`; these controllers report nothing, so it is what was sent;
        None while the controller manager says that it is not active.
        """
        listed = self.listed()
        with self._lock:
            if self._forwarder is None or (listed is not None and listed.state != "active"):
                return None
            return self._forwarder.report(self._measured, time.monotonic())
