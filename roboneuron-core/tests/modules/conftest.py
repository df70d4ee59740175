"""Modules run inside the test process on their own ROS graph, with a node that simulates the other
processes.
"""

from __future__ import annotations

import importlib.metadata
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within
from roboneuron.config import ModuleSettings, parse_config
from roboneuron.modules.settings import ModuleKind
from roboneuron.ros.environment import prepare_environment

HERE = Path(__file__).parent
BASE = """
[robot]
name = "pair"
command_timeout_s = 0.3
[perception]
source = "noise"
[inference]
backend = "instant"
instruction = "go"
[control]
controller = "adder"
action_timeout_s = 0.3
"""


class World:
    """A separate ROS context with one node for the test and the modules it starts, spun by a
    thread.
    """

    def __init__(self, state_directory: Path) -> None:
        self.state_directory = state_directory
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
        prepare_environment(state_directory / "log")
        import rclpy
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = rclpy.create_node("world", namespace="pair")
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.modules: list[Any] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._stop.is_set():
            self.executor.spin_once(timeout_sec=0.05)

    def run(self, function: Callable[[], Any]) -> Any:
        """Call `function` on the executor's thread, like a ROS callback, and return its result."""
        task = self.executor.create_task(function)
        assert holds_within(task.done, 10.0), "the executor did not run the task"
        return task.result()

    def permit(self, node: Any) -> None:
        """Permit motion after a stop, as the server does on a new request."""
        from rclpy.parameter import Parameter

        from roboneuron.modules.settings import START_PARAMETER

        asked = [Parameter(START_PARAMETER, value=node.stops)]
        assert self.run(lambda: node.set_parameters(asked))[0].successful

    def module(
        self,
        kind: ModuleKind,
        *,
        extra: str = "",
        replace: dict[str, str] | None = None,
        shadow: bool = False,
    ) -> Any:
        """Build a module's node; the caller triggers its transitions."""
        from roboneuron.modules.control.module import ControlModule
        from roboneuron.modules.inference.module import InferenceModule
        from roboneuron.modules.module import ModuleNode
        from roboneuron.modules.perception.module import PerceptionModule
        from roboneuron.modules.robot import RobotModule

        classes = {
            "control": ControlModule,
            "inference": InferenceModule,
            "perception": PerceptionModule,
            "robot": RobotModule,
        }
        settings = ModuleSettings(
            kind=kind,
            node_name=kind,
            config=parse_config(edited(extra, replace)),
            state_directory=str(self.state_directory),
            on_join=("loop_plugin:join", "roboneuron.tools.arm.limit_reports:join"),
            is_successor=shadow,
        )
        node = ModuleNode(settings, classes[kind])
        self.executor.add_node(node)
        self.modules.append(node)
        return node

    def start(self, kind: ModuleKind, **options: Any) -> Any:
        """Build, configure and activate a module."""
        from rclpy.lifecycle import TransitionCallbackReturn

        node = self.module(kind, **options)
        for transition in (node.trigger_configure, node.trigger_activate):
            assert self.run(transition) is TransitionCallbackReturn.SUCCESS, (
                node.status.to_message().message
            )
        return node

    def listen(self, message_type: Any, topic: str) -> list[Any]:
        """A growing list of the messages on a topic."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, 10)
        return received

    def publisher(self, message_type: Any, topic: str, qos: Any = 1) -> Any:
        """A publisher that is matched with its subscriber."""
        publisher = self.node.create_publisher(message_type, topic, qos)
        assert holds_within(lambda: publisher.get_subscription_count() > 0), (
            f"nobody listens on {topic}"
        )
        return publisher

    def close(self) -> None:
        """End modules, node and context."""
        import rclpy

        self._stop.set()
        self._thread.join(5.0)
        for node in self.modules:
            node.release()
            node.destroy_node()
        self.node.destroy_node()
        rclpy.try_shutdown()


class Clock:
    """A monotonic and a wall clock controlled by the test."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.wall_ns = 1_700_000_000_000_000_000

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return self.wall_ns

    def go(self, seconds: float) -> None:
        """Advance both clocks."""
        self.now_s += seconds
        self.wall_ns += round(seconds * 1e9)


class Publisher:
    """Records published messages."""

    def __init__(self, message_type: type) -> None:
        self.message_type = message_type
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(message)


class Host:
    """A module's view of its node, without ROS: the test calls the module's subscriptions.

    Attributes:
        publishers, subscribed, parameters: by topic or name, until they are released.
        periods_s: periods of timers.
        silence_s: since the server's last sign of life.
        foreign: names of foreign nodes that publish commands.
    """

    def __init__(self, settings: ModuleSettings, clock: Clock) -> None:
        from loop_plugin import Windows

        from roboneuron.modules.status import StatusWriter

        self.settings, self.clock = settings, clock
        self.status = StatusWriter(settings.status_name)
        self.handover = Windows(settings.is_successor, self.status)
        self.filters = [self.handover]
        self.resources = ExitStack()
        self.stopped = False
        self.needs_start = ""
        self.silence_s = 0.0
        self.foreign = ""
        self.publishers: dict[str, Publisher] = {}
        self.subscribed: dict[tuple[type, str], Callable[..., None]] = {}
        self.parameters: dict[str, tuple[Any, Callable[..., Any], Callable[..., Any]]] = {}
        self.repeated: list[tuple[float, Callable[[], None]]] = []
        self.on_configured: list[Callable[[Any], None]] = []

    def now_ns(self) -> int:
        return self.clock.wall_ns

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.clock.wall_ns))

    def is_server_silent(self) -> bool:
        robot, control = self.settings.config.robot, self.settings.config.control
        return self.silence_s > min(robot.server_timeout_s, control.server_timeout_s)

    def advertise(self, message_type: type, topic: str) -> Publisher:
        publisher = self.publishers[topic] = Publisher(message_type)
        return publisher

    def subscribe(self, message_type: type, topic: str, callback: Callable[..., None]) -> None:
        self.subscribed[message_type, topic] = callback

    def senders(self, topic: str) -> str:
        return self.foreign

    def repeat(self, period_s: float, callback: Callable[[], None]) -> None:
        self.repeated.append((period_s, callback))

    def add_parameter(
        self,
        name: str,
        value: Any,
        take: Callable[..., Any],
        refuse: Callable[..., Any] = lambda _: "",
    ) -> Callable[[], None]:
        self.parameters[name] = (value, take, refuse)
        return lambda: self.parameters.__delitem__(name)

    def require_start(self, reason: str, code: str = "needs_new_start") -> None:
        self.needs_start = reason

    def drops(self) -> dict[str, int]:
        return dict(self.status.dropped)

    def values(self) -> dict[str, str]:
        return status(self)


def install_loop_plugin(folder: Path) -> Path:
    """Install loop_plugin.py and its backends below a folder; return the import path."""
    site = folder / "site"
    info = site / "rn_loop-1.0.dist-info"
    info.mkdir(parents=True)
    for name in ("loop_plugin.py", "loop_backends.py"):
        shutil.copy(HERE / name, site)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rn-loop\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-loop = loop_plugin\n")
    return site


@pytest.fixture(scope="session")
def loop_site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return install_loop_plugin(tmp_path_factory.mktemp("loop"))


@pytest.fixture
def make_host(
    loop_site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., Host]]:
    """Return a function that makes a host of a module of that kind; all are released at the end.

    The modules use the host's clock.
    """
    from roboneuron.modules import command_guard, holding, module_host, robot
    from roboneuron.modules.control import module as control
    from roboneuron.plugins.discovery import discover

    monkeypatch.syspath_prepend(str(loop_site))
    points = [
        point
        for distribution in importlib.metadata.distributions(path=[str(loop_site)])
        for point in distribution.entry_points
    ]
    monkeypatch.setattr(module_host, "discover", partial(discover, points=points))
    clock = Clock()
    for one in (control, command_guard, holding, robot):
        monkeypatch.setattr(one, "time", clock)
    made: list[Host] = []

    def make(
        kind: ModuleKind, *, extra: str = "", replace: dict[str, str] | None = None, **options: Any
    ) -> Host:
        settings = ModuleSettings(
            kind=kind,
            node_name=kind,
            config=parse_config(edited(extra, replace)),
            state_directory=str(tmp_path),
            **options,
        )
        made.append(Host(settings, clock))
        return made[-1]

    yield make
    for host in made:
        host.resources.close()


def edited(extra: str, replace: dict[str, str] | None) -> str:
    """The configuration BASE with replacements."""
    text = BASE + extra
    for old, new in (replace or {}).items():
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.fixture
def no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not start the threads of a robot module: the test calls their steps."""
    from robot_cell import Steps

    from roboneuron.modules import robot

    monkeypatch.setattr(robot, "Worker", Steps)


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A world with the plugin of loop_plugin.py installed."""
    monkeypatch.syspath_prepend(str(install_loop_plugin(tmp_path)))
    for key in ("ROS_DOMAIN_ID", "ROS_LOG_DIR"):
        monkeypatch.setenv(key, "")
        monkeypatch.delenv(key)
    created = World(tmp_path / "state")
    yield created
    created.close()


def status(node: Any) -> dict[str, str]:
    """A module's report as a dictionary, including "message" and "level"."""
    message = node.status.to_message()
    values = {pair.key: pair.value for pair in message.values}
    return values | {"message": message.message, "level": str(message.level)}


@pytest.fixture(name="status_of")
def _status_of() -> Callable[[Any], dict[str, str]]:
    return status


@pytest.fixture
def make_inference(world: World, status_of: Any) -> Callable[..., Any]:
    """Return a function that starts inference with a backend: an `inference_cell.Cell`."""
    from inference_cell import Cell

    return lambda backend, **options: Cell(world, status_of, backend, **options)
