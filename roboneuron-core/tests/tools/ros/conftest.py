"""A server in this process and a robot beside it: a node of a ROS context of its own with topics,
services, actions.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, types

from rn_standard.ops.plugin import CLIENTS
from rn_testing.domain import free_ros_domain
from rn_testing.fakes import fake_registry
from rn_testing.waiting import holds_within
from roboneuron.config import parse_config
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.plugins.registry import Registry
from roboneuron.ros.environment import prepare_environment
from roboneuron.server.app import Application
from roboneuron.tools.arm.plugin import FEATURE as ARM_FEATURE
from roboneuron.tools.ros.plugin import FEATURE

EXPOSED = """
[robot]
name = "rover"
[server]
reset_emergency_stop = "client"
[direct_path]
max_duration_s = 20
[direct]
listed_tools = 40
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
summary = "Drive."
bounds = { "linear.x" = [-0.5, 0.5], "angular.z" = [-1, 1] }
clamp = ["angular.z"]
stop_message = "zero"
repeat_hz = 20.0
[[expose]]
name = "velocity"
robot = "second"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
summary = "Drive slowly."
bounds = { "linear.x" = [-0.1, 0.1] }
stop_message = "zero"
repeat_hz = 20.0
[[expose]]
name = "speech"
kind = "publish"
topic = "say"
type = "std_msgs/msg/String"
moves = false
rate_hz = 1000
[[expose]]
name = "latched"
kind = "publish"
topic = "mode"
type = "std_msgs/msg/Int32"
[[expose]]
name = "lonely"
kind = "publish"
topic = "nobody"
type = "std_msgs/msg/Empty"
require_subscriber = false
[[expose]]
name = "battery"
kind = "read"
topic = "battery"
type = "sensor_msgs/msg/BatteryState"
[[expose]]
name = "picture"
kind = "read"
topic = "/rover/image"
type = "sensor_msgs/msg/Image"
[[expose]]
name = "light"
kind = "service"
topic = "light"
type = "std_srvs/srv/SetBool"
[[expose]]
name = "absent"
kind = "service"
topic = "absent"
type = "std_srvs/srv/Trigger"
[[expose]]
name = "count"
kind = "action"
topic = "count"
type = "test_msgs/action/Fibonacci"
bounds = { "order" = [0, 100] }
[[expose]]
name = "robot_node"
kind = "parameters"
topic = "robot_node"
parameters = ["label", "nothing"]
bounds = { "gain" = [0, 10] }
"""


class Rover:
    """Notes what arrives, with the monotonic time of arrival, and answers."""

    def __init__(self) -> None:
        import rclpy
        from geometry_msgs.msg import Twist
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.executors import MultiThreadedExecutor
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from std_msgs.msg import Int32, String
        from std_srvs.srv import SetBool
        from test_msgs.action import Fibonacci

        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("robot_node", namespace="rover", context=self.context)
        self.node.declare_parameter("gain", 1.5)
        self.node.declare_parameter("label", "a")
        self.node.declare_parameter("secret", "b")
        self.received: list[tuple[float, str, Any]] = []
        self.goals: list[str] = []
        group = ReentrantCallbackGroup()
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._note(Twist, "cmd_vel", 50)
        self._note(Twist, "/second/cmd_vel", 50)
        self._note(String, "say", 10000)
        self._note(Int32, "mode", latched)
        self.node.create_service(SetBool, "light", self._on_light)
        self.server = ActionServer(
            self.node, Fibonacci, "count", self._on_goal, callback_group=group,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )  # fmt: skip
        self.executor = MultiThreadedExecutor(3, context=self.context)
        self.executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        from rclpy.exceptions import InvalidHandle
        from rclpy.executors import ExternalShutdownException

        # a last task may end while the executor is shut down
        with suppress(ExternalShutdownException, InvalidHandle):
            self.executor.spin()

    def _note(self, message_type: type, topic: str, qos: Any) -> None:
        def take(message: Any) -> None:
            self.received.append((time.monotonic(), topic, message))

        self.node.create_subscription(message_type, topic, take, qos)

    def _on_light(self, request: Any, response: Any) -> Any:
        response.success, response.message = request.data, "on" if request.data else "off"
        return response

    def _on_goal(self, goal: Any) -> Any:
        from test_msgs.action import Fibonacci

        feedback = Fibonacci.Feedback(sequence=[0, 1])
        for _ in range(goal.request.order):
            if goal.is_cancel_requested:
                goal.canceled()
                self.goals.append("canceled")
                return Fibonacci.Result()
            feedback.sequence.append(feedback.sequence[-1] + feedback.sequence[-2])
            goal.publish_feedback(feedback)
            time.sleep(0.05)
        if goal.request.order == 7:
            goal.abort()
            self.goals.append("aborted")
        else:
            goal.succeed()
            self.goals.append("succeeded")
        return Fibonacci.Result(sequence=feedback.sequence)

    def publish_often(self, message_type: type, topic: str, message: Any, qos: Any = 10) -> Any:
        """Publish at 20 Hz; cancel what is returned to end it."""
        publisher = self.node.create_publisher(message_type, topic, qos)
        return self.node.create_timer(0.05, lambda: publisher.publish(message))

    def on(self, topic: str) -> list[Any]:
        """Messages of a topic, in order."""
        return [message for _, name, message in self.received if name == topic]

    def close(self) -> None:
        """Leave the graph."""
        self.executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self.server.destroy()  # it would keep the node on the graph, for the next test to meet
        self.node.destroy_node()
        self.context.try_shutdown()


class Agent:
    """A real MCP client of an application in this process."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.progress: list[str] = []

    async def call(self, name: str, arguments: dict[str, Any]) -> types.CallToolResult:
        """The raw answer."""
        self.progress = []

        async def note(progress: float, total: float | None, message: str | None) -> None:
            self.progress.append(message or "")

        return await self.client.call_tool(name, arguments, progress_callback=note)

    async def do(self, name: str, **arguments: Any) -> dict[str, Any]:
        """The structured result of a call that must succeed."""
        answer = await self.call(name, arguments)
        assert not answer.is_error, answer.content
        result: dict[str, Any] = answer.structured_content
        return result

    async def fail(self, name: str, **arguments: Any) -> tuple[str, str]:
        """Code and text of a call that must fail."""
        answer = await self.call(name, arguments)
        assert answer.is_error, answer.structured_content
        return answer.meta["roboneuron/error"]["code"], answer.content[0].text  # type: ignore[union-attr]


def run_agent(
    application: Application, scenario: Callable[[Agent], Any], mode: str = "auto"
) -> None:
    """Connect a client and run the scenario."""

    async def connect() -> None:
        async with Client(application.server, mode=mode) as client:  # type: ignore[arg-type]
            await client.list_tools()
            await scenario(Agent(client))

    anyio.run(connect)


@pytest.fixture(scope="session")
def _domain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    before = os.environ.get("ROS_DOMAIN_ID")
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(tmp_path_factory.mktemp("ros"))
    yield
    if before is None:
        del os.environ["ROS_DOMAIN_ID"]
    else:
        os.environ["ROS_DOMAIN_ID"] = before


@pytest.fixture
def make_application(tmp_path: Path) -> Iterator[Callable[..., Application]]:
    """Return a function that builds an application from the text of a configuration."""
    made: list[Application] = []

    def make(text: str = EXPOSED, registry: Registry | None = None) -> Application:
        found = registry or fake_registry(DIRECT_PATH, FEATURE, CLIENTS)
        application = Application(
            parse_config(text),
            plugins=lambda: found,
            directory=tmp_path / "state",
            command=lambda python: pytest.fail("nothing may be spawned"),
        )
        made.append(application)
        return application

    yield make
    for application in made:
        application.close()


@pytest.fixture
def application(make_application: Callable[..., Application]) -> Application:
    """The application of EXPOSED; ROS is joined when a call needs it."""
    return make_application()


@pytest.fixture
def rover(_domain: None) -> Iterator[Rover]:
    """The robot."""
    robot = Rover()
    yield robot
    robot.close()


@pytest.fixture
def ask(application: Application, rover: Rover) -> Callable[..., None]:
    """Run a scenario with a client while the robot is there and the server has discovered it."""
    node = application.supervisor.link.node
    assert holds_within(
        lambda: ("robot_node", "/rover") in node.get_node_names_and_namespaces(), 10.0
    )
    return lambda scenario, mode="auto": run_agent(application, scenario, mode)


@pytest.fixture
def run_with(make_application: Callable[..., Application]) -> Callable[..., None]:
    """Run a scenario with a client of a server that has this configuration."""
    return lambda text, scenario: run_agent(make_application(text), scenario)


@pytest.fixture
def run_arm(make_application: Callable[..., Application]) -> Callable[..., None]:
    """Like `run_with`, on a server that has the arm tools too."""
    registry = fake_registry(DIRECT_PATH, FEATURE, ARM_FEATURE, CLIENTS)
    return lambda text, scenario: run_agent(make_application(text, registry), scenario)
