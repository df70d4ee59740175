"""A port whose file was removed under its listener is noticed, and opened again, so that new
senders reach it.

The listener is a process of its own: Fast DDS crashed once when a participant was destroyed in the
moment in which its own thread opened a port again, and a crash must end no other test.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from rn_standard.fastdds.segments import PORT_PREFIX, SHARED_MEMORY

pytestmark = pytest.mark.ros

SENDER = """
import rclpy, time
from std_msgs.msg import String
rclpy.init()
publisher = rclpy.create_node("sender").create_publisher(String, "spoken", 1)
while True:
    publisher.publish(String(data="word"))
    time.sleep(0.02)
"""

# Answers each line of its input, [name, argument], with a line: the ports it opened, what
# `LostPorts.look` gave back, or whether it heard three words within that many seconds.
LISTENER = f"""
import json, os, sys, time
wire = os.dup(1)
os.dup2(2, 1)  # Fast DDS warns on standard output
import rclpy
from rclpy.executors import SingleThreadedExecutor
from std_msgs.msg import String
from rn_standard.fastdds.lost_ports import LostPorts
from rn_standard.fastdds.segments import owned_segments

before = owned_segments(os.getpid())
rclpy.init()
node = rclpy.create_node("listener")
words = []
node.create_subscription(String, "spoken", words.append, 1)
executor = SingleThreadedExecutor()
executor.add_node(node)
lost_ports = LostPorts()

def ports(_):
    return sorted(n for n in owned_segments(os.getpid()) - before if n.startswith({PORT_PREFIX!r}))

def look(_):
    return lost_ports.look()

def hears(within_s):
    words.clear()
    deadline_s = time.monotonic() + within_s
    while len(words) < 3 and time.monotonic() < deadline_s:
        executor.spin_once(timeout_sec=0.05)
    return len(words) >= 3

for line in sys.stdin:
    name, argument = json.loads(line)
    answer = {{"ports": ports, "look": look, "hears": hears}}[name](argument)
    os.write(wire, json.dumps(answer).encode() + b"\\n")
"""


class Listener:
    """A subscriber in a process of its own, and the ports that came with it."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", LISTENER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.ports: list[str] = self._ask("ports")

    def _ask(self, name: str, argument: float | None = None) -> Any:
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(json.dumps([name, argument]) + "\n")
        stdin.flush()
        answer = stdout.readline()
        assert answer, f"the listener ended at {name!r}"
        return json.loads(answer)

    def look(self) -> list[int]:
        """The numbers of the ports that were given back."""
        return list(self._ask("look"))

    def hears(self, within_s: float) -> bool:
        return bool(self._ask("hears", within_s))

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


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


def test_listener_whose_port_was_removed_hears_again(
    listener: Listener, speak: Callable[[], object]
) -> None:
    assert listener.ports
    for name in listener.ports:
        (SHARED_MEMORY / name).unlink()
    speak()
    assert not listener.hears(4.0), "nothing is lost, so nothing is shown"
    assert listener.look() == [], "it may be a change under way"
    assert listener.look() == sorted(int(name.removeprefix(PORT_PREFIX)) for name in listener.ports)
    assert listener.hears(5.0)
    assert (listener.look(), listener.look()) == ([], [])


def test_port_that_is_found_by_its_name_is_left_alone(
    listener: Listener, speak: Callable[[], object]
) -> None:
    speak()
    assert listener.hears(10.0)
    inodes = [(SHARED_MEMORY / name).stat().st_ino for name in listener.ports]
    assert [listener.look() for _ in range(4)] == [[]] * 4
    assert [(SHARED_MEMORY / name).stat().st_ino for name in listener.ports] == inodes
