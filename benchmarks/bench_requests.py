"""Fourteen everyday requests to a served FR3, by a scripted client that keeps everything an agent
would read.

    python benchmarks/bench_requests.py [--only 3 5] [--engine pybullet] [--record-s 5]

The client reads tools/list once; each request then uses only listed tools and their answers. A
request has five checks, one point each: that there is a tool for it, that its calls work, that the
answers contain what the person asked for, and the simulator's state (`detail.cubes` of get_status),
which an agent does not read. Printed are the score and the bytes of the answers of each request,
and the bytes of tools/list. Exit status 1 if a request has less than 4.

Requests follow each other on one robot, as in a conversation. If a person must agree, the client's
simulated person does.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import anyio
from agent_requests import Agent, Seen, requests
from mcp import Client, StdioServerParameters, types

from rn_testing.domain import free_ros_domain

LEAST = 4
ANSWER_S = 180.0
SCENARIO_S = 1500.0
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[inference]
backend = "servo"
[control]
controller = "urdf"
[plugins.fr3]
engine = "{engine}"
[supervisor]
start_timeout_s = 180.0
state_directory = "{state}"
"""


async def run(arguments: argparse.Namespace, folder: Path) -> list[tuple[str, Seen]]:
    """Run the conversation; prints a line for each request."""
    config = folder / "roboneuron.toml"
    config.write_text(CONFIG.format(state=folder / "state", engine=arguments.engine))
    environment = {
        **os.environ,
        "ROS_DOMAIN_ID": str(free_ros_domain()),
        "ROBONEURON_RECORDER": "on",
        "ROBONEURON_SIMULATOR_TRUTH": "on",
    }
    command = [
        "-m",
        "roboneuron.cli.main",
        "serve",
        "--config",
        str(config),
        "--log-level",
        "error",
    ]
    server = StdioServerParameters(command=sys.executable, args=command, env=environment)

    async def person(context: Any, params: Any) -> types.ElicitResult:
        return types.ElicitResult(action="accept", content={"confirmed": True})

    done: list[tuple[str, Seen]] = []
    async with Client(server, elicitation_callback=person, read_timeout_seconds=ANSWER_S) as client:
        listing = await client.list_tools()
        size = len(listing.model_dump_json(by_alias=True, exclude_none=True))
        print(f"tools/list: {len(listing.tools)} tools, {size} bytes\n")
        agent = Agent(client, {tool.name: tool for tool in listing.tools})
        for number, (text, request) in enumerate(requests(arguments.record_s), 1):
            if arguments.only and number not in arguments.only:
                continue
            agent.seen = Seen()
            began_s = time.monotonic()
            try:
                await request(agent)
            except Exception as error:  # a request that cannot be evaluated keeps the points it has
                agent.check(f"{type(error).__name__}: {error}", False)
            agent.seen.took_s = time.monotonic() - began_s
            _show(number, text, agent.seen)
            done.append((text, agent.seen))
    return done


def _show(number: int, text: str, seen: Seen) -> None:
    print(
        f"{number:2} {seen.score} of 5 {seen.size:8} bytes {seen.took_s:6.1f} s  {text}", flush=True
    )
    for what, is_met in seen.checks:
        if not is_met:
            print(f"      not: {what}", flush=True)


def main() -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--only", type=int, nargs="+", default=[], help="numbers of requests")
    parser.add_argument("--engine", default="auto", help="physics: auto, pybullet or mujoco")
    parser.add_argument(
        "--record-s", type=float, default=5.0, help="the minute that is recorded [s]"
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="rn-requests-") as folder:

        async def bounded() -> list[tuple[str, Seen]]:
            with anyio.fail_after(SCENARIO_S):
                return await run(arguments, Path(folder))

        done = anyio.run(bounded)
    scores = [seen.score for _, seen in done]
    total = sum(seen.size for _, seen in done)
    print(
        f"\nscores {' '.join(map(str, scores))}; {sum(scores)} of {5 * len(scores)}; answers "
        f"{total} bytes"
    )
    return int(min(scores, default=0) < LEAST)


if __name__ == "__main__":
    raise SystemExit(main())
