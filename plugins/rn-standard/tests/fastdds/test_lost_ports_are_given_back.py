"""A port whose file was removed under its listener is noticed, and opened again, so that new senders reach it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String

from rn_standard.fastdds.lost_ports import LostPorts
from rn_standard.fastdds.segments import PORT_PREFIX, SHARED_MEMORY, owned_segments

pytestmark = pytest.mark.ros
Look = Callable[[LostPorts], list[int]]
SENDER = """
import rclpy, time
from std_msgs.msg import String
rclpy.init()
publisher = rclpy.create_node("sender").create_publisher(String, "spoken", 1)
while True:
    publisher.publish(String(data="word"))
    time.sleep(0.02)
"""


class Listener:
    """A subscriber of its own participant, and the ports that came with it."""

    def __init__(self) -> None:
        before = owned_segments(os.getpid())
        self.context = rclpy.Context()
        self.context.init()
        self.node = rclpy.create_node("listener", context=self.context)
        self.heard = 0
        self.node.create_subscription(String, "spoken", self._on_word, 1)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.ports = sorted(n for n in owned_segments(os.getpid()) - before if n.startswith(PORT_PREFIX))

    def _on_word(self, _: String) -> None:
        self.heard += 1

    def hears(self, within_s: float) -> bool:
        before, deadline_s = self.heard, time.monotonic() + within_s
        while self.heard < before + 3 and time.monotonic() < deadline_s:
            self.executor.spin_once(timeout_sec=0.05)
        return self.heard >= before + 3

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.shutdown()


@pytest.fixture
def listener() -> Iterator[Listener]:
    listener = Listener()
    yield listener
    listener.close()


@pytest.fixture
def speak() -> Iterator[Callable[[], object]]:
    started: list[subprocess.Popen[bytes]] = []
    yield lambda: started.append(subprocess.Popen([sys.executable, "-c", SENDER]))
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
def look(monkeypatch: pytest.MonkeyPatch) -> Look:
    """Looks when told to; the thread that earlier tests may have started in this process sees nothing."""
    look = LostPorts.look
    monkeypatch.setattr(LostPorts, "look", lambda self: [])
    return look


def test_listener_whose_port_was_removed_hears_again(
    listener: Listener, speak: Callable[[], object], look: Look
) -> None:
    for name in listener.ports:
        (SHARED_MEMORY / name).unlink()
    speak()
    assert not listener.hears(4.0), "nothing is lost, so nothing is shown"
    ports = LostPorts()
    assert look(ports) == [], "it may be a change under way"
    assert look(ports) == sorted(int(name.removeprefix(PORT_PREFIX)) for name in listener.ports)
    assert listener.hears(5.0)
    assert (look(ports), look(ports)) == ([], [])


def test_port_that_is_found_by_its_name_is_left_alone(
    listener: Listener, speak: Callable[[], object], look: Look
) -> None:
    speak()
    assert listener.hears(10.0)
    ports = LostPorts()
    inodes = [(SHARED_MEMORY / name).stat().st_ino for name in listener.ports]
    assert [look(ports) for _ in range(4)] == [[]] * 4
    assert [(SHARED_MEMORY / name).stat().st_ino for name in listener.ports] == inodes
