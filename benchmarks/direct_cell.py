"""Processes of the benchmark of the direct path: a server, a floor, a subscriber."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcp import Client, StdioServerParameters

CALL_S = 60.0
"""Longest wait for an answer of a server; starts take up to 30 s."""
TRIVIAL = """
import os, time
import anyio
from mcp import types
from mcp.server import Server
from roboneuron.stdio.message_stream import LineWriter, MessageStream

async def main():
    writer = LineWriter(os.dup(1))
    reader = MessageStream(os.dup(0), writer.write, 192)
    reader.start()
    writer.start()
    schema = {"type": "object"}
    async def listing(context, params):
        return types.ListToolsResult(tools=[types.Tool(name="nothing", description="Nothing.", input_schema=schema)])
    async def call(context, params):
        at = {"at_ns": time.monotonic_ns()}
        return types.CallToolResult(content=[types.TextContent(type="text", text="{}")], structured_content=at)
    server = Server("trivial", on_list_tools=listing, on_call_tool=call)
    await server.run(reader, reader, server.create_initialization_options())

anyio.run(main)
"""  # noqa: E501
SUBSCRIBER = """
import os, time
wire = os.dup(1)
os.dup2(2, 1)  # Fast DDS warns on standard output
import rclpy
from geometry_msgs.msg import Twist

rclpy.init()
node = rclpy.create_node("listener", namespace="bench")

def take(message):
    line = f"{time.monotonic_ns()} {message.linear.x!r} {message.linear.y!r}\\n"
    os.write(wire, line.encode())

node.create_subscription(Twist, "cmd_vel", take, 100)
os.write(wire, b"up\\n")
rclpy.spin(node)
"""


class Listener:
    """A subscriber in its own process that reports the arrival of each message."""

    def __init__(self, folder: Path) -> None:
        self._out = (folder / "listener.txt").open("w+b")
        command = [sys.executable, "-c", SUBSCRIBER]
        self._process = subprocess.Popen(command, stdout=self._out, stderr=subprocess.DEVNULL)
        self._reader = (folder / "listener.txt").open("rb")
        self._rest = b""
        self._lines: list[tuple[int, float, float]] = []
        self._wait_for_line()

    def _wait_for_line(self) -> None:
        end_s = time.monotonic() + 30
        while time.monotonic() < end_s:
            if self._reader.readline().startswith(b"up"):
                return
            time.sleep(0.01)
        raise SystemExit("The subscriber did not come up.")

    def poll(self) -> list[tuple[int, float, float]]:
        """All arrivals: time [ns], linear.x, linear.y."""
        self._rest += self._reader.read()
        *complete, self._rest = self._rest.split(b"\n")
        for line in complete:
            at, x, y = line.split()
            self._lines.append((int(at), float(x), float(y)))
        return self._lines

    def arrival_ns(self, mark: float, timeout_s: float = 2.0) -> int | None:
        """Arrival of the message with linear.y == mark; blocks."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            found = next((at for at, _, y in reversed(self.poll()) if y == mark), None)
            if found is not None:
                return found
            time.sleep(0.0005)
        return None

    def close(self) -> None:
        """End the process so that it leaves the graph: a killed one would count as a subscriber of
        the next publisher until its lease expires.
        """
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)


def configuration(folder: Path, endpoints: int, repeat: bool) -> Path:
    """Configuration of a robot without a plugin, with that number of endpoints."""
    lines = ["[robot]", 'name = "bench"', "[server]", 'reset_emergency_stop = "client"']
    lines += ["[supervisor]", f'state_directory = "{folder / "state"}"']
    twist = 'kind = "publish"\ntype = "geometry_msgs/msg/Twist"'
    stop = 'stop_message = "zero"\nrepeat_hz = 20.0' if repeat else 'stop_message = ""'
    for index in range(endpoints):
        name, topic = (
            ("velocity", "cmd_vel") if index == 0 else (f"wheel_{index}", f"part_{index}/cmd_vel")
        )
        bounds = 'bounds = { "linear.x" = [-1, 1], "angular.z" = [-2, 2] }'
        lines += [
            "[[expose]]",
            f'name = "{name}"',
            f'topic = "{topic}"',
            twist,
            bounds,
            stop if index == 0 else 'stop_message = ""',
        ]
    path = folder / f"bench_{endpoints}_{repeat}.toml"
    path.write_text("\n".join(lines))
    return path


SERVE = (
    "import gc, logging, sys\ngc.disable()\nlogging.basicConfig(level='ERROR')\nfrom pathlib "
    "import Path\n"
    "from roboneuron.config import load_config\n"
    "from roboneuron.cli.serve import divert_standard_streams\nwire = divert_standard_streams()\n"
    "import roboneuron.server.app as app\n"
    "app.check_configuration = lambda *a: None\n"
    "app.serve(load_config(Path(sys.argv[1])), wire)\n"
)


def server(path: Path) -> StdioServerParameters:
    """RoboNeuron's server, quiet; without the check that the robot's plugin is installed, because
    there is none.
    """
    return StdioServerParameters(
        command=sys.executable, args=["-c", SERVE, str(path)], env=with_bytecode()
    )


def with_bytecode() -> dict[str, str]:
    """The environment of a process whose start is timed. Users start a program repeatedly, but
    without stored bytecode each start would compile 320 modules.
    """
    return {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}


def bounded(parameters: StdioServerParameters) -> Client:
    """A client whose calls fail without an answer in time."""
    return Client(parameters, read_timeout_seconds=CALL_S)


@contextmanager
def publisher() -> Iterator[Any]:
    """The bare rclpy publisher, in this process."""
    import rclpy
    from geometry_msgs.msg import Twist

    rclpy.init()
    node = rclpy.create_node("floor", namespace="bench")
    made = node.create_publisher(Twist, "cmd_vel", 10)
    end_s = time.monotonic() + 10
    while made.get_subscription_count() < 1 and time.monotonic() < end_s:
        time.sleep(0.01)
    if made.get_subscription_count() < 1:
        raise SystemExit("The subscriber was not discovered within 10 s.")
    time.sleep(0.2)

    def publish(mark: float) -> None:
        message = Twist()
        message.linear.y = mark
        made.publish(message)

    try:
        yield publish
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
