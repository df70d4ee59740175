"""start_all compared with the four start calls in sequence: time to the first action, interleaved
on the same server.

    python benchmarks/bench_start_all.py [--cycles 5]

Each cycle starts everything with an instruction both ways, in alternating order, and stops
everything in between. "First action" is the return of the last call: by then inference has
published an action for the instruction.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import anyio
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client

from rn_standard.demo.agent import DemoAgent
from rn_testing.domain import free_ros_domain
from roboneuron.ros.environment import prepare_environment

INSTRUCTION = {"instruction": "pick up the red cube"}
LARGEST_RATIO = 0.6


async def in_a_row(agent: DemoAgent) -> None:
    """The four calls, one after the other."""
    for module in ("robot", "perception", "control"):
        await agent.call(f"start_{module}")
    await agent.call("start_inference", INSTRUCTION)


async def at_once(agent: DemoAgent) -> None:
    """One call."""
    await agent.call("start_all", INSTRUCTION)


async def measure(cycles: int, scratch: Path) -> dict[str, list[float]]:
    """Seconds to the first action, for each way."""
    os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    prepare_environment(scratch / "log")
    parameters = StdioServerParameters(
        command=sys.executable, args=["-m", "roboneuron.cli.main", "serve"], env=dict(os.environ)
    )
    took: dict[str, list[float]] = {"in a row": [], "at once": []}
    ways = {"in a row": in_a_row, "at once": at_once}
    with (scratch / "server.log").open("w") as log:
        async with Client(stdio_client(parameters, errlog=log), read_timeout_seconds=180) as client:
            agent = DemoAgent(client)
            await agent.status()
            for cycle in range(cycles + 1):
                for name in sorted(ways, reverse=bool(cycle % 2)):
                    started_s = time.perf_counter()
                    await ways[name](agent)
                    if cycle:  # the first cycle warms the disk cache
                        took[name].append(time.perf_counter() - started_s)
                    await agent.call("stop_all")
    return took


def main() -> int:
    """Measure and print; status 1 if the bound does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--cycles", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the times here")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        took = anyio.run(measure, arguments.cycles, Path(scratch))
    if arguments.json:
        arguments.json.write_text(json.dumps(took))
    for name, values in took.items():
        listed = ", ".join(f"{value:.2f}" for value in values)
        print(
            f"{name:9}: median {statistics.median(values):.2f} s, best {min(values):.2f} s  "
            f"({listed})"
        )
    ratio = statistics.median(a / b for a, b in zip(took["at once"], took["in a row"], strict=True))
    print(f"ratio    : {ratio:.2f} (median of the cycles; at most {LARGEST_RATIO:g})")
    return int(ratio > LARGEST_RATIO)


if __name__ == "__main__":
    sys.exit(main())
