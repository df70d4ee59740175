"""Direct path: time from the agent's call to the message at a subscriber in another process,
compared with two floors.

    python benchmarks/bench_direct.py [--calls 300] [--stops 100] [--starts 3] [--sizes 3 100 1000]

Floors, interleaved with RoboNeuron in the same run: a tool that does nothing, on the same transport
(stdio, MCP SDK, the same line reader and writer), and a bare rclpy publish to the same subscriber.
The empty tool is timed twice: until it answers, and one way, until its handler is entered.
RoboNeuron is timed until the message is at the subscriber, and until the answer. "overhead" is
RoboNeuron minus the sum of both floors at the same percentile. The relevant one is "one way",
because the other includes the floor's way back and looks too good. Times are taken on one host with
one clock (CLOCK_MONOTONIC), from just before the call to the subscriber's callback. The start of
the server is timed from the spawn of its process to the answer of `initialize`, of the first
`tools/list`, and to the first message at the subscriber (which waits for ROS to be joined and
matched). The stop is measured from the emergency_stop call to the zero message at the subscriber,
during a 10 s sequence.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
from direct_cell import CALL_S, TRIVIAL, Listener, bounded, configuration, publisher, server
from mcp import StdioServerParameters
from rich.console import Console
from rich.table import Table

from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

BUDGET_MS = 0.3


def percentile(values: list[float], share: float) -> float:
    """Smallest value that is not exceeded by this fraction: of 100 values, p99 is the second
    largest.
    """
    return sorted(values)[max(0, math.ceil(share * len(values)) - 1)]


async def measure(
    size: int, calls: int, listener: Listener, folder: Path, publish: Any
) -> dict[str, list[float]]:
    """Milliseconds of RoboNeuron and both floors, interleaved in each round."""
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
                    "call_tool", {"tool": "publish_velocity", "arguments": arguments}
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
    """Milliseconds to the zero message, from the call of emergency_stop and from cancelling the
    sequence.
    """
    stops: list[float] = []
    cancels: list[float] = []
    steps = [{"message": {"linear": {"x": x}}, "duration_s": 5.0} for x in (0.5, 0.25)]
    async with bounded(server(configuration(folder, 3, True))) as client:
        await client.list_tools()
        for index in range(count * 2):
            # until the previous motion has released the robot, and its last message has arrived
            with anyio.fail_after(30):
                while not (
                    await client.call_tool(
                        "publish_velocity_sequence", {"steps": steps, "simulate": True}
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
    """Start of the server, the median for each size."""
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
    """Run both measurements; status 1 if a message was lost."""
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
