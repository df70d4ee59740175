"""An agent starts a model on one machine and moves the running task to another one by its name;
each is a network namespace. A machine out of reach cannot take the task over. Needs root.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from link_machines import Machine, Talker, impossible, machines
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from policy_servers import FarServer, pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
WATCHER = Path(__file__).parents[2] / "rn-link" / "tests" / "link_watcher.py"
HOSTS = ("gpu", "attic")
CONFIG = """
[robot]
name = "fr3"
[perception]
source = "fr3-sim-camera"
[control]
controller = "urdf"
[plugins.fr3-sim-camera]
width = 64
height = 64
[models.only]
backend = "reflex"
host = "gpu"
[hosts.gpu]
address = "gpu:7420"
options = { timeout_s = 0.4 }
[hosts.attic]
address = "attic:7420"
options = { timeout_s = 0.4 }
"""
STEP_S, ROWS = 0.1, 16
MOVED_RAD = 0.003


@contextmanager
def served(tmp_path: Path) -> Iterator[tuple[Mapping[str, Machine], Mapping[str, FarServer]]]:
    """The robot's machine and two machines with a policy server each, all paired."""
    with machines(tmp_path, "robot", *HOSTS) as made, ExitStack() as stack:
        robot, servers = made["robot"], {}
        for name in HOSTS:
            pair(robot.state, made[name].state, name=name, address=made[name].address)
            folder = tmp_path / name[0]  # short enough for the path of a socket
            folder.mkdir()
            model = {"only": {"options": {"rows": ROWS, "step_s": STEP_S, "gain": 0.00006}}}
            listen = {"host": "0.0.0.0", "port": 7420}
            server = FarServer(folder, model, listen, made[name].state)
            server.machine = made[name]
            stack.callback(server.end)
            servers[name] = server
            server.start()
        yield made, servers


class Agent:
    """A client of the robot's server."""

    def __init__(self, client: Client) -> None:
        self._client = client

    async def call(self, tool: str, **arguments: Any) -> tuple[bool, dict[str, Any], str]:
        """Call a tool; returns success, structured content and text."""
        answer = await self._client.call_tool(tool, arguments)
        text = answer.content[0].text  # type: ignore[union-attr]
        return not answer.is_error, dict(answer.structured_content or {}), text

    async def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """The answer of a call that must succeed."""
        succeeded, answer, text = await self.call(tool, **arguments)
        assert succeeded, text
        return answer


def batches(server: FarServer) -> int:
    """Number of requests answered by this machine."""
    return int(server.status()["models"]["only"]["batches"])


def check_it_moves(watcher: Talker) -> None:
    """Wait until a joint of the arm has moved."""
    wait_until(lambda: watcher.report().get("positions"), 60.0, "the arm is measured")
    begun = np.array(watcher.report()["positions"])
    wait_until(
        lambda: np.abs(np.array(watcher.report()["positions"]) - begun).max() > MOVED_RAD,
        60.0,
        "the arm moves",
    )


async def check_it_asks(agent: Agent, servers: Mapping[str, FarServer], name: str) -> None:
    """Check that requests go to the named machine, and that the status shows it."""
    status = json.dumps(await agent.do("get_status"))
    assert f'"host": "{name}"' in status, status
    before = {host: batches(server) for host, server in servers.items()}
    with anyio.fail_after(30.0):
        while batches(servers[name]) < before[name] + 5:
            await anyio.sleep(0.1)
    (other,) = set(HOSTS) - {name}
    assert batches(servers[other]) - before[other] <= 1, "the other one rests"


async def move_between(
    made: Mapping[str, Machine], servers: Mapping[str, FarServer], watcher: Talker
) -> None:
    """Run the scenario."""
    robot = made["robot"]
    config = robot.state / "roboneuron.toml"
    config.write_text(CONFIG)
    words = ["-m", "roboneuron.cli.main", "serve", "--config", str(config), "--log-level", "error"]
    command, *arguments = robot.inside(sys.executable, *words)
    parameters = StdioServerParameters(
        command=command,
        args=arguments,
        env={**os.environ, "XDG_STATE_HOME": str(robot.state)},
    )
    async with Client(stdio_client(parameters)) as client:
        agent = Agent(client)
        for tool in ("start_robot", "start_perception", "start_control"):
            await agent.do(tool)
        await agent.do("start_inference", model="only", host="attic", instruction="go on")
        await anyio.to_thread.run_sync(check_it_moves, watcher)
        await check_it_asks(agent, servers, "attic")
        missed = []
        for name in ("gpu", "attic", "gpu"):
            switched = await agent.do("switch_inference", model="only", host=name)
            assert switched["mode"] == "warm"
            missed.append(switched["missed"])
            await check_it_asks(agent, servers, name)
            await anyio.to_thread.run_sync(check_it_moves, watcher)
        print(f"periods missed at each switch: {missed}")
        assert min(missed) == 0, missed
        assert max(missed) <= 1, "a busy machine may cost one"
        made["attic"].cut()
        succeeded, _, said = await agent.call("switch_inference", model="only", host="attic")
        assert not succeeded
        assert "attic" in said, said
        await check_gpu_goes_on(agent, servers["gpu"])
        await anyio.to_thread.run_sync(check_it_moves, watcher)
        await agent.do("stop_all")


async def check_gpu_goes_on(agent: Agent, server: FarServer) -> None:
    """Check that the running policy still gets requests after a failed switch."""
    before = batches(server)
    with anyio.fail_after(30.0):
        while batches(server) < before + 5:
            await anyio.sleep(0.1)
    assert '"host": "gpu"' in json.dumps(await agent.do("get_status"))


def test_a_running_task_moves_between_machines_and_stays_where_the_other_is_out_of_reach(
    tmp_path: Path,
) -> None:
    with served(tmp_path) as (made, servers):
        watcher = made["robot"].talk("watcher", script=WATCHER)
        anyio.run(move_between, made, servers, watcher)
