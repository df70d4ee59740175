"""Ten starts and stops of the whole loop over MCP: their times, and leftovers.

    python benchmarks/bench_start_stop.py [--cycles 10]

Counts what belongs to the server (child processes, sockets) and Fast DDS files in shared memory
after each cycle; run it on a machine without other DDS processes. The floor is a bare rclpy
process: spawn, import, create a node, leave.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import psutil
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from rich.console import Console
from rich.table import Table

from rn_standard.demo.agent import DemoAgent
from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

MODULES = ("robot", "perception", "control", "inference")
BARE_NODE = (
    "import rclpy; rclpy.init(); n = rclpy.create_node('bare'); n.destroy_node(); "
    "rclpy.try_shutdown()"
)


def left_behind(server: psutil.Process) -> dict[str, int]:
    """Existing resources: the server's children, their and its sockets, files in shared memory, the
    server's threads.
    """
    family = [server, *server.children(recursive=True)]
    return {
        "children": len(family) - 1,
        "sockets": sum(len(process.net_connections()) for process in family),
        "shared memory files": sum(1 for p in Path("/dev/shm").iterdir() if "fastrtps" in p.name),
        "server threads": server.num_threads(),
        "server handles": server.num_fds(),
    }


def floor_s(repeats: int) -> float:
    """Median time of a bare rclpy process [s]."""
    times = []
    for _ in range(repeats):
        started_s = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", BARE_NODE], check=True, env=dict(os.environ), timeout=60
        )
        times.append(time.perf_counter() - started_s)
    return float(np.median(times))


async def cycle(agent: DemoAgent) -> tuple[dict[str, float], float]:
    """Start everything, stop everything; seconds per start, and for all stops."""
    took: dict[str, float] = {}
    for module in MODULES:
        started_s = time.perf_counter()
        await agent.call(f"start_{module}")
        took[module] = time.perf_counter() - started_s
    started_s = time.perf_counter()
    await agent.call("stop_all")
    return took, time.perf_counter() - started_s


async def measure(cycles: int, scratch: Path) -> tuple[Table, Table]:
    """Run all cycles against one server."""
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(scratch / "log")
    before_shm = sum(1 for p in Path("/dev/shm").iterdir() if "fastrtps" in p.name)
    parameters = StdioServerParameters(
        command=sys.executable, args=["-m", "roboneuron.cli.main", "serve"], env=dict(os.environ)
    )
    starts: list[dict[str, float]] = []
    stops: list[float] = []
    leaks: list[dict[str, int]] = []
    with (scratch / "server.log").open("w") as log:
        async with Client(stdio_client(parameters, errlog=log), read_timeout_seconds=120) as client:
            agent = DemoAgent(client)
            server = psutil.Process((await agent.status())["pid"])
            leaks.append(left_behind(server))
            for _ in range(cycles):
                took, stop_s = await cycle(agent)
                starts.append(took)
                stops.append(stop_s)
                leaks.append(left_behind(server))
    after_shm = sum(1 for p in Path("/dev/shm").iterdir() if "fastrtps" in p.name)
    return _times(starts, stops), _leaks(leaks, before_shm, after_shm)


def _times(starts: list[dict[str, float]], stops: list[float]) -> Table:
    floor = floor_s(5)
    table = Table(title=f"{len(starts)} starts and stops of the whole loop over MCP")
    for column in ("what", "median s", "worst s", "x a bare rclpy process"):
        table.add_column(column, justify="right")
    rows: list[tuple[str, Any]] = [(f"start_{m}, ready", [s[m] for s in starts]) for m in MODULES]
    for name, values in [*rows, ("stop_all", stops), ("bare rclpy process", [floor])]:
        median = float(np.median(values))
        table.add_row(name, f"{median:.2f}", f"{max(values):.2f}", f"{median / floor:.1f}")
    return table


def _leaks(leaks: list[dict[str, int]], before_shm: int, after_shm: int) -> Table:
    table = Table(title="What is left behind")
    for column in ("what", "before", "after 1", f"after {len(leaks) - 1}", "more"):
        table.add_column(column, justify="right")
    for key in leaks[0]:
        first, one, last = leaks[0][key], leaks[1][key], leaks[-1][key]
        table.add_row(key, str(first), str(one), str(last), str(last - one))
    table.add_row(
        "shared memory files, server gone",
        str(before_shm),
        "",
        str(after_shm),
        str(after_shm - before_shm),
    )
    return table


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cycles", type=int, default=10)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        for table in anyio.run(measure, arguments.cycles, Path(directory)):
            Console(width=120).print(table)


if __name__ == "__main__":
    main()
