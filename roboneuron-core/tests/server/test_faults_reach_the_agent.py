"""Reports to the agent when modules die or freeze, and a stop from the command line."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters, types
from mcp.shared.exceptions import MCPDeprecationWarning

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
STATUS = "roboneuron://status"


class Agent:
    """A client of the older protocol version that has subscribed to the status."""

    def __init__(self, client: Client) -> None:
        self.client = client

    async def do(self, name: str, **arguments: Any) -> dict[str, Any]:
        answer = await self.client.call_tool(name, arguments)
        assert not answer.is_error, answer.content
        return dict(answer.structured_content or {})

    async def module(self, kind: str) -> dict[str, Any]:
        status = await self.do("get_status", details=True)
        return next(m for m in status["modules"] if m["module"] == kind)

    async def until(self, fact: Callable[[], Awaitable[bool]], timeout_s: float) -> None:
        with anyio.fail_after(timeout_s):
            while not await fact():
                await anyio.sleep(0.05)

    async def until_health(self, kind: str, *words: str, timeout_s: float = 5.0) -> None:
        async def is_so() -> bool:
            return (await self.module(kind))["health"] in words

        await self.until(is_so, timeout_s)


def release_in_terminal(command: list[str], environment: dict[str, str]) -> None:
    """Act as a person: run the command in a terminal, and confirm."""
    person, terminal = pty.openpty()
    try:
        os.write(person, b"y\n")
        subprocess.run(command, env=environment, stdin=terminal, check=True, timeout=60)
    finally:
        os.close(person)
        os.close(terminal)


def test_faults_are_told_and_survived(
    serve_command: Callable[..., list[str]], server_environment: dict[str, str], tmp_path: Path
) -> None:
    updates: list[str] = []

    async def on_message(message: Any) -> None:
        if isinstance(message, types.ResourceUpdatedNotification):
            updates.append(str(message.params.uri))

    async def scenario(agent: Agent) -> None:
        await agent.do("start_robot")
        await agent.do("start_perception")
        await agent.do("start_control")
        await agent.do("start_inference", instruction="move on")
        await agent.until_health("inference", "ok")
        assert (await agent.module("inference"))["work_limit_s"] > 0

        before = len(updates)
        control = await agent.module("control")
        os.kill(control["pid"], signal.SIGSTOP)
        await agent.until_health("control", "silent", timeout_s=2.0)

        async def is_told() -> bool:
            return len(updates) > before

        await agent.until(is_told, 2.0)
        assert set(updates) == {STATUS}
        os.kill(control["pid"], signal.SIGCONT)
        await agent.until_health("control", "ok")

        perception = await agent.module("perception")
        os.kill(perception["pid"], signal.SIGKILL)
        await agent.until_health("perception", "exited", timeout_s=2.0)

        await agent.do("start_perception")
        assert (await agent.module("perception"))["pid"] != perception["pid"]
        await agent.until_health("inference", "ok")
        assert not (await agent.module("inference"))["instruction"], (
            "a module that ended needs a new start"
        )

        estop = [
            sys.executable,
            "-m",
            "roboneuron.cli.main",
            "estop",
            "--state",
            str(tmp_path / "state"),
        ]
        run = await anyio.run_process([*estop, "--reason", "smoke"], env=server_environment)
        assert b"latched" in run.stdout
        for kind in ("robot", "control", "inference"):

            async def is_stopped(kind: str = kind) -> bool:
                return (await agent.module(kind))["emergency_stop"] is True

            await agent.until(is_stopped, 2.0)
        status = await agent.do("get_status")
        assert status["emergency_stop"]
        assert status["emergency_stop_cause"].endswith('at the command line: "smoke"')
        assert (
            subprocess.run(
                [*estop, "--status"], env=server_environment, capture_output=True
            ).returncode
            == 1
        )

        async def is_released() -> bool:
            return not (await agent.do("get_status"))["emergency_stop"]

        await anyio.to_thread.run_sync(release_in_terminal, [*estop, "--reset"], server_environment)
        await agent.until(is_released, 2.0)

        for pid in (status["pid"], (await agent.module("robot"))["pid"]):
            os.kill(pid, signal.SIGUSR1)
            for kind in ("robot", "control", "inference"):

                async def is_stopped_too(kind: str = kind) -> bool:
                    return (await agent.module(kind))["emergency_stop"] is True

                await agent.until(is_stopped_too, 2.0)
            assert "SIGUSR1" in (await agent.do("get_status"))["emergency_stop_cause"]
            await anyio.to_thread.run_sync(
                release_in_terminal, [*estop, "--reset"], server_environment
            )
            await agent.until(is_released, 2.0)

    async def connect() -> None:
        command = serve_command()
        path = tmp_path / "roboneuron.toml"
        path.write_text(f'{path.read_text()}[ops.restart]\nperception = "never"\n')
        server = StdioServerParameters(command=command[0], args=command[1:], env=server_environment)
        async with Client(server, mode="legacy", message_handler=on_message) as client:
            with pytest.warns(MCPDeprecationWarning):
                await client.session.subscribe_resource(STATUS)
            await scenario(Agent(client))

    anyio.run(connect)
    audit = [
        json.loads(line) for line in (tmp_path / "state" / "audit.jsonl").read_text().splitlines()
    ]
    assert [a["tool"] for a in audit if "command line" in a["who"]] == [
        "estop",
        *3 * ["reset_emergency_stop"],
    ]
