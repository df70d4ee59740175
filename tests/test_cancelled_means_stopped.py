"""What moves is at rest soon after its call is cancelled, whatever the way, transport and protocol.

A base is judged by what its wheels are told, a goal by its action server, an arm by its measured
joints. A way that cancels nothing is answered so, or is no cancellation in its protocol; then the
motion goes on, and the row says why. A service that was called cannot be recalled.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from cancel_table import Table, printed
from cancel_wire import (
    HTTP_WAYS,
    LAST_WAYS,
    STDIO_WAYS,
    TOKENS,
    HttpClient,
    StdioClient,
    Way,
    answered,
    check_cell,
    served,
)
from mcp_types.version import KNOWN_PROTOCOL_VERSIONS

from rn_testing.domain import free_ros_domain
from rn_testing.fakes.wheels import CommandedWheels
from rn_testing.waiting import holds_within, wait_until
from roboneuron.ros.environment import prepare_environment

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]
NEWEST = "2026-07-28"
REST_S = 2.0
"""Bound for a busy machine; benchmarks/results.toml has the time itself, milliseconds."""
BASE = """
[robot]
name = "diffdrive"
[supervisor]
state_directory = "{folder}/state"
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
repeat_hz = 20.0
[[expose]]
name = "count"
kind = "action"
topic = "count"
type = "test_msgs/action/Fibonacci"
bounds = {{ "order" = [0, 1000] }}
[[expose]]
name = "hold"
kind = "service"
topic = "hold"
type = "std_srvs/srv/Trigger"
"""
FORWARD = {"linear": {"x": 0.3}}
CALLS: dict[str, tuple[str, dict[str, Any]]] = {
    "publish": ("publish_velocity", {"message": FORWARD, "duration_s": 20}),
    "sequence": (
        "publish_velocity_sequence",
        {"steps": [{"message": FORWARD, "duration_s": 5.0}], "times": 4},
    ),
    "goal": ("send_count_goal", {"goal": {"order": 1000}, "timeout_s": 60}),
    "service": ("call_hold", {"request": {}, "timeout_s": 60}),
}


class CountingServer:
    """An action server that counts until it is cancelled, and a service that ends when it may.

    Attributes:
        running: goals that are being carried out.
        holding: calls of the service that have not ended.
    """

    def __init__(self, domain: int) -> None:
        import rclpy
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.executors import MultiThreadedExecutor
        from std_srvs.srv import Trigger
        from test_msgs.action import Fibonacci

        self.running = self.holding = 0
        self._may_end = threading.Semaphore(0)
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=domain)
        self._node = rclpy.create_node("counts", namespace="diffdrive", context=self._context)
        self._server = ActionServer(
            self._node,
            Fibonacci,
            "count",
            self._carry_out,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )
        self._node.create_service(
            Trigger, "hold", self._hold, callback_group=ReentrantCallbackGroup()
        )
        self._executor = MultiThreadedExecutor(3, context=self._context)
        self._executor.add_node(self._node)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _carry_out(self, goal: Any) -> Any:
        from test_msgs.action import Fibonacci

        self.running += 1
        while not goal.is_cancel_requested and not self._end.wait(0.01):
            pass
        self.running -= 1
        goal.canceled() if goal.is_cancel_requested else goal.abort()
        return Fibonacci.Result()

    def _hold(self, request: Any, response: Any) -> Any:
        self.holding += 1
        self._may_end.acquire(timeout=60.0)
        self.holding -= 1
        return response

    def let_end(self) -> None:
        """Let a call of the service end."""
        self._may_end.release()

    def close(self) -> None:
        self._end.set()
        self._executor.shutdown(timeout_sec=2.0)
        self._thread.join(timeout=2.0)
        self._server.destroy()
        self._node.destroy_node()
        self._context.try_shutdown()


@dataclass
class Base:
    """A base and an action server on a ROS domain of their own, and the servers that move them."""

    folder: Path
    environment: dict[str, str]
    wheels: CommandedWheels
    counting: CountingServer
    stack: ExitStack
    url: str = ""
    kept: dict[str, StdioClient] = field(default_factory=dict)

    def configuration(self, name: str) -> Path:
        path = self.folder / f"{name}.toml"
        path.write_text(BASE.format(folder=self.folder / name) + TOKENS)
        return path

    def client(self, transport: str, version: str, way: Way) -> HttpClient | StdioClient:
        """A client of a server over HTTP, or of a server of its own over stdio."""
        if transport == "http":
            if not self.url:
                server = served(self.configuration("http"), self.environment, transport="http")
                self.url = self.stack.enter_context(server)[1]
            return HttpClient(self.url, version)
        if version not in self.kept:
            server = served(self.configuration(version), self.environment, transport="stdio")
            self.kept[version] = StdioClient(self.stack.enter_context(server)[0], version)
        if way in LAST_WAYS:  # the server ends too
            return self.kept.pop(version)
        return self.kept[version]

    def moves(self, call: str) -> bool:
        if call == "goal":
            return self.counting.running > 0
        return bool(self.wheels.speeds) and self.wheels.speeds[-1] != 0.0


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Base]:
    folder, domain = tmp_path_factory.mktemp("base"), free_ros_domain()
    prepare_environment(folder / "ros")
    environment = {"ROS_DOMAIN_ID": str(domain), "XDG_STATE_HOME": str(folder)}
    wheels, counting = CommandedWheels(domain, "diffdrive"), CountingServer(domain)
    with ExitStack() as stack:
        stack.callback(wheels.close)
        stack.callback(counting.close)
        yield Base(folder, environment, wheels, counting, stack)


def why_not(transport: str, version: str, way: str, call: str) -> str:
    """Why there is no such cell; empty if there is one."""
    if way == "session deleted" and version == NEWEST:
        return "this protocol has no sessions"
    return ""


def cells() -> Iterator[Any]:
    """Transport, protocol, way, call: the newest two protocols in the default lane, for one call
    or way each.
    """
    quick = {("http", NEWEST), ("http", "2025-11-25"), ("stdio", NEWEST)}
    for transport, ways in (("http", HTTP_WAYS), ("stdio", STDIO_WAYS)):
        for version in KNOWN_PROTOCOL_VERSIONS:
            for way in ways:
                for call in CALLS:
                    if why_not(transport, version, way, call):
                        continue
                    is_quick = (transport, version) in quick and (
                        call == "publish" or way == "notification"
                    )
                    marks = () if is_quick else (pytest.mark.slow, pytest.mark.timeout(150))
                    row = (transport, version, way, call)
                    yield pytest.param(*row, id="-".join(row).replace(" ", "_"), marks=marks)


@pytest.fixture(scope="module")
def table() -> Iterator[Table]:
    with printed(Table(CALLS), why_not) as made:
        yield made


@pytest.mark.parametrize(("transport", "version", "way", "call"), list(cells()))
def test_a_base_rests_after_its_call_is_cancelled(
    base: Base, table: Table, transport: str, version: str, way: Way, call: str
) -> None:
    def moves() -> bool:
        return base.moves(call)

    with table.cell(transport, version, way, call) as tell:
        client = base.client(transport, version, way)
        if call == "service":
            tell(check_service(base.counting, client, way))
            return
        tell(check_cell(client, way, CALLS[call], moves, lambda: not moves(), REST_S))


def check_service(server: CountingServer, client: HttpClient | StdioClient, way: Way) -> str:
    """A service cannot be recalled: its call ends, and it goes on."""
    tool, arguments = CALLS["service"]
    try:
        client.begin(tool, arguments)
        wait_until(lambda: server.holding > 0, 60.0, "the service is called")
        assert client.cancel(way) == answered(client.transport, client.version, way)
        assert not holds_within(lambda: server.holding == 0, 0.3)
        assert not client.has_succeeded()
    finally:
        server.let_end()
        client.leave_call()
    wait_until(lambda: server.holding == 0, 60.0, "the service ends")
    return "not recalled"
