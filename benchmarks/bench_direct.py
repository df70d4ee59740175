"""Direct path: from the agent's call to the message at a subscriber in another process, beside its
two floors.

    python benchmarks/bench_direct.py [--calls 300] [--stops 100] [--starts 3] [--sizes 3 100 1000]

Floors, in the same run and in turns with ours: a tool that does nothing, on the same transport as
ours (stdio, MCP SDK, our line reader and writer), and a bare rclpy publish to the same subscriber.
The tool is timed twice: until it answers, and one way, until its handler is entered. Ours is timed
until the message is at the subscriber, and until it answers. "overhead" is ours minus the sum of
both floors at the same percentile; the one that counts is "one way", because in the other the
floor's way back flatters us. Times are taken on one host with one clock (CLOCK_MONOTONIC), from
just before the call to the subscriber's callback. The start of the server is timed from the spawn
of its process to the answer of `initialize`, of the first `tools/list`, and to the first message at
the subscriber (which waits for ROS to be joined and matched). The stop is measured from the
emergency_stop call to the zero message at the subscriber, during a 10 s sequence.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import anyio
from mcp import Client, StdioServerParameters
from rich.console import Console
from rich.table import Table

from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

TOPIC = "/bench/cmd_vel"
BUDGET_MS = 0.3
CALL_S = 60.0
"""Longest wait for an answer of a server; starts take up to 30 s."""
TRIVIAL = """
import os, time
import anyio
from mcp import types
from mcp.server import Server
from rn_standard.stdio.message_stream import LineWriter, MessageStream

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
import sys, time
import rclpy
from geometry_msgs.msg import Twist

rclpy.init()
node = rclpy.create_node("listener", namespace="bench")

def take(message):
    sys.stdout.write(f"{time.monotonic_ns()} {message.linear.x!r} {message.linear.y!r}\\n")
    sys.stdout.flush()

node.create_subscription(Twist, "cmd_vel", take, 100)
print("up", flush=True)
rclpy.spin(node)
"""


class Listener:
    """A subscriber in a process of its own that tells when each message arrived."""

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
        """Everything that has arrived: time [ns], linear.x, linear.y."""
        self._rest += self._reader.read()
        *complete, self._rest = self._rest.split(b"\n")
        for line in complete:
            at, x, y = line.split()
            self._lines.append((int(at), float(x), float(y)))
        return self._lines

    def arrival_ns(self, mark: float, timeout_s: float = 2.0) -> int | None:
        """When the message with linear.y == mark arrived; blocks."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            found = next((at for at, _, y in reversed(self.poll()) if y == mark), None)
            if found is not None:
                return found
            time.sleep(0.0005)
        return None

    def close(self) -> None:
        """End the process, which leaves the graph: the next publisher would take one that was
        killed for a subscriber until its lease runs out.
        """
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)


def configuration(folder: Path, endpoints: int, repeat: bool) -> Path:
    """A robot that no plugin knows, with that many endpoints."""
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
    """Our server, quiet; the check that the robot's plugin is installed is left out, because the
    robot is none.
    """
    return StdioServerParameters(
        command=sys.executable, args=["-c", SERVE, str(path)], env=with_bytecode()
    )


def with_bytecode() -> dict[str, str]:
    """The environment of a process whose start is timed: users start what they started before, and
    where bytecode is not kept, each start compiles 320 modules.
    """
    return {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}


def bounded(parameters: StdioServerParameters) -> Client:
    """A client whose calls fail when no answer comes."""
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


def percentile(values: list[float], share: float) -> float:
    """The smallest value that this share of them does not exceed: of 100 values, p99 is the second
    largest.
    """
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


async def measure(
    size: int, calls: int, listener: Listener, folder: Path, publish: Any
) -> dict[str, list[float]]:
    """Milliseconds of ours and both floors, one after the other in each round."""
    times: dict[str, list[float]] = {
        "tool": [],
        "entered": [],
        "publish": [],
        "ours": [],
        "round trip": [],
    }
    trivial = StdioServerParameters(
        command=sys.executable, args=["-c", TRIVIAL], env=dict(os.environ)
    )
    async with (
        bounded(trivial) as floor,
        bounded(server(configuration(folder, size, False))) as client,
    ):
        started = time.monotonic()
        listed = await client.list_tools()
        times["list"] = [(time.monotonic() - started) * 1e3]
        times["list_bytes"] = [float(len(listed.model_dump_json(by_alias=True, exclude_none=True)))]
        direct = any(tool.name == "publish_velocity" for tool in listed.tools)
        for index in range(-20, calls):
            mark = float(index + 1000 + size * 1e6)
            begun = time.monotonic_ns()
            nothing = await floor.call_tool("nothing", {})
            tool_ms = (time.monotonic_ns() - begun) / 1e6
            entered_ms = (nothing.structured_content["at_ns"] - begun) / 1e6
            begun = time.monotonic_ns()
            publish(-mark)
            arrived = listener.arrival_ns(-mark)
            publish_ms = ((arrived or 0) - begun) / 1e6
            arguments: dict[str, Any] = {"message": {"linear": {"x": 0.5, "y": mark}}}
            begun = time.monotonic_ns()
            if direct:
                answer = await client.call_tool("publish_velocity", arguments)
            else:
                answer = await client.call_tool(
                    "call_endpoint", {"tool": "publish_velocity", "arguments": arguments}
                )
            ended = time.monotonic_ns()
            assert not answer.is_error, answer.content
            ours = listener.arrival_ns(mark)
            if index >= 0 and arrived is not None and ours is not None:
                times["tool"].append(tool_ms)
                times["entered"].append(entered_ms)
                times["publish"].append(publish_ms)
                times["ours"].append((ours - begun) / 1e6)
                times["round trip"].append((ended - begun) / 1e6)
        if not direct:
            begun_s = time.monotonic()
            await client.call_tool(
                "find_tools", {"query": f"wheel {size // 2}", "schemas": True, "limit": 3}
            )
            times["find"] = [(time.monotonic() - begun_s) * 1e3]
    return times


async def measure_stops(
    count: int, listener: Listener, folder: Path
) -> tuple[list[float], list[float]]:
    """Milliseconds from the call of emergency_stop, and from cancelling the sequence, to the zero
    message.
    """
    stops: list[float] = []
    cancels: list[float] = []
    steps = [{"message": {"linear": {"x": x}}, "duration_s": 5.0} for x in (0.5, 0.25)]
    async with bounded(server(configuration(folder, 3, True))) as client:
        await client.list_tools()
        for index in range(count * 2):
            # until the motion before has let go of the robot, and its last message is here
            with anyio.fail_after(30):
                while not (
                    await client.call_tool(
                        "publish_velocity_sequence", {"steps": steps, "dry_run": True}
                    )
                ).structured_content["allowed"]:
                    await anyio.sleep(0.01)
            await anyio.sleep(0.1)
            seen = len(listener.poll())
            with anyio.CancelScope() as scope:
                async with anyio.create_task_group() as group:
                    group.start_soon(
                        lambda: client.call_tool("publish_velocity_sequence", {"steps": steps})
                    )
                    with anyio.fail_after(30):
                        while len(listener.poll()) <= seen:
                            await anyio.sleep(0.005)
                    await anyio.sleep(random.uniform(0.02, 0.12))
                    begun = time.monotonic_ns()
                    if index % 2:
                        scope.cancel()
                    else:
                        await client.call_tool("emergency_stop", {"reason": "benchmark"})
            end_s = time.monotonic() + 3
            found = None
            while found is None and time.monotonic() < end_s:
                found = next((at for at, x, _ in listener.poll() if at > begun and x == 0.0), None)
                await anyio.sleep(0.001)
            (cancels if index % 2 else stops).append(
                (found - begun) / 1e6 if found else float("inf")
            )
            if not index % 2:
                await client.call_tool("reset_emergency_stop", {})
    return stops, cancels


async def measure_start(size: int, listener: Listener, folder: Path) -> tuple[float, float, float]:
    """Seconds from the spawn to the answer of initialize, of tools/list, and to the first
    message.
    """
    mark = time.monotonic()
    begun = time.monotonic_ns()
    async with bounded(server(configuration(folder, size, False))) as client:
        ready = time.monotonic_ns()
        await client.list_tools()
        listed = time.monotonic_ns()
        arguments: dict[str, Any] = {"message": {"linear": {"y": mark}}, "timeout_s": 30}
        answer = await client.call_tool("publish_velocity", arguments)
        assert not answer.is_error, answer.content
        arrived = listener.arrival_ns(mark, CALL_S)
    if arrived is None:
        raise SystemExit(f"The first message did not arrive within {CALL_S:g} s.")
    return (ready - begun) / 1e9, (listed - begun) / 1e9, (arrived - begun) / 1e9


def show_starts(console: Console, rows: dict[int, list[tuple[float, float, float]]]) -> None:
    """The start of the server, the median of each size."""
    table = Table(title="From the spawn of `serve` [s], median", title_justify="left")
    for column in ("endpoints", "starts", "initialize", "tools/list", "first message"):
        table.add_column(column, justify="right")
    for size, starts in rows.items():
        medians = (percentile([start[part] for start in starts], 0.5) for part in range(3))
        table.add_row(str(size), str(len(starts)), *(f"{value:.2f}" for value in medians))
    console.print(table)


def show_delivery(console: Console, rows: dict[int, dict[str, list[float]]]) -> None:
    """Both tables of the first measurement."""
    table = Table(
        title="Call to message at a subscriber in another process [ms]", title_justify="left"
    )
    columns = (
        "endpoints",
        "",
        "tool",
        "tool one way",
        "publish",
        "ours",
        "overhead",
        "one way",
        "answered",
        "budget",
    )
    for column in columns:
        table.add_column(column, justify="right")
    for size, times in rows.items():
        for word, share in (("median", 0.5), ("p99", 0.99)):
            tool, entered, publish, ours, answered = (
                percentile(times[key], share)
                for key in ("tool", "entered", "publish", "ours", "round trip")
            )
            one_way = ours - entered - publish
            budget = (
                f"{BUDGET_MS} {'kept' if one_way <= BUDGET_MS else 'missed'}"
                if word == "median"
                else ""
            )
            values = (
                tool,
                entered,
                publish,
                ours,
                ours - tool - publish,
                one_way,
                answered - tool - publish,
            )
            table.add_row(str(size), word, *(f"{v:.2f}" for v in values), budget)
    console.print(table)
    usable = Table(title="What the agent reads", title_justify="left")
    for column in ("endpoints", "tools/list [kB]", "tools/list [ms]", "find_tools [ms]"):
        usable.add_column(column, justify="right")
    for size, times in rows.items():
        find = f"{times['find'][0]:.1f}" if "find" in times else "not needed"
        usable.add_row(
            str(size), f"{times['list_bytes'][0] / 1e3:.0f}", f"{times['list'][0]:.0f}", find
        )
    console.print(usable)


def main() -> int:
    """Run both measurements; status 1 when a message was lost."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calls", type=int, default=300)
    parser.add_argument("--stops", type=int, default=100)
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--sizes", type=int, nargs="+", default=[3, 100, 1000])
    parser.add_argument("--json", type=Path, help="write the raw milliseconds here")
    arguments = parser.parse_args()
    console = Console(width=110)
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare_environment(folder / "log")
        listener = Listener(folder)
        try:
            with publisher() as publish:
                rows = {
                    size: anyio.run(measure, size, arguments.calls, listener, folder, publish)
                    for size in arguments.sizes
                }
            show_delivery(console, rows)
            starts = {
                size: [
                    anyio.run(measure_start, size, listener, folder)
                    for _ in range(arguments.starts)
                ]
                for size in arguments.sizes
            }
            show_starts(console, starts)
            stops, cancels = anyio.run(measure_stops, arguments.stops, listener, folder)
        finally:
            listener.close()
    table = Table(
        title="From the call to the zero message, during a 10 s sequence [ms]", title_justify="left"
    )
    for column in ("", "n", "median", "p99", "max", "budget"):
        table.add_column(column, justify="right")
    for word, values in (("emergency_stop", stops), ("cancelled call", cancels)):
        row = (percentile(values, 0.5), percentile(values, 0.99), max(values))
        table.add_row(word, str(len(values)), *(f"{v:.1f}" for v in row), "50")
    console.print(table)
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"delivery": rows, "starts": starts, "stops": stops, "cancels": cancels})
        )
    lost = sum(arguments.calls - len(times["ours"]) for times in rows.values())
    if lost:
        console.print(f"{lost} messages did not arrive.")
    return 1 if lost else 0


if __name__ == "__main__":
    sys.exit(main())
