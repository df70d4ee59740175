"""Modules run inside the test process on a ROS graph of their own, beside a node that plays the
rest of the world.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rn_testing.domain import free_ros_domain
from rn_testing.waiting import holds_within
from roboneuron.config import parse_config
from roboneuron.modules.settings import ModuleKind, ModuleSettings
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
    """A ROS context of its own with one node for the test and the modules it starts, spun by a
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
        """Call `function` on the executor's thread, as ROS callbacks are, and return its result."""
        task = self.executor.create_task(function)
        assert holds_within(task.done, 10.0), "the executor did not run the task"
        return task.result()

    def permit(self, node: Any) -> None:
        """Let a module obey after a stop, as the server does when somebody asks for motion."""
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
        from roboneuron.modules.control import ControlModule
        from roboneuron.modules.inference import InferenceModule
        from roboneuron.modules.module import ModuleNode
        from roboneuron.modules.perception import PerceptionModule
        from roboneuron.modules.robot import RobotModule

        text = BASE + extra
        for old, new in (replace or {}).items():
            assert old in text
            text = text.replace(old, new)
        classes = {
            "control": ControlModule,
            "inference": InferenceModule,
            "perception": PerceptionModule,
            "robot": RobotModule,
        }
        settings = ModuleSettings(
            kind=kind,
            node_name=kind,
            config=parse_config(text),
            state_directory=str(self.state_directory),
            on_join=("loop_plugin:join",),
            shadow=shadow,
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
        """Messages arriving on a topic, as a list that grows."""
        received: list[Any] = []
        self.node.create_subscription(message_type, topic, received.append, 10)
        return received

    def publisher(self, message_type: Any, topic: str) -> Any:
        """A publisher that has found its subscriber."""
        publisher = self.node.create_publisher(message_type, topic, 1)
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


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    """A world with the plugin of loop_plugin.py installed."""
    site = tmp_path / "site"
    info = site / "rn_loop-1.0.dist-info"
    info.mkdir(parents=True)
    shutil.copy(HERE / "loop_plugin.py", site)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rn-loop\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[roboneuron]\nrn-loop = loop_plugin\n")
    monkeypatch.syspath_prepend(str(site))
    for key in ("ROS_DOMAIN_ID", "ROS_LOG_DIR"):
        monkeypatch.setenv(key, "")
        monkeypatch.delenv(key)
    created = World(tmp_path / "state")
    yield created
    created.close()


def status(node: Any) -> dict[str, str]:
    """What a module reports, as a dictionary; "message" and "level" included."""
    message = node.status.to_message()
    values = {pair.key: pair.value for pair in message.values}
    return values | {"message": message.message, "level": str(message.level)}


@pytest.fixture(name="status_of")
def _status_of() -> Callable[[Any], dict[str, str]]:
    return status
