"""A test agent in its own process, so that it can run on another machine than the robot's server:
`far_agent.py URL`, its token in ROBONEURON_TOKEN.

It reads calls as lines of JSON, [tool, arguments], and writes the answers, [success, structured
content, text]. In addition it calls `heartbeat`, between the lines `beat` and `rest`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import anyio
import httpx2
from link_machines import Machine
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

BEAT_S, CALL_S = 0.8, 120.0


class FarAgent:
    """A test's connection to the agent; closed with its process.

    Args:
        machine: machine of the agent.
        url: URL of the robot's server.
        token: token of the agent.
    """

    def __init__(self, machine: Machine, url: str, token: str) -> None:
        self._process = subprocess.Popen(
            machine.inside(sys.executable, __file__, url),
            env={**os.environ, "ROBONEURON_TOKEN": token, "PYTHONPATH": os.pathsep.join(sys.path)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def _write(self, value: object) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(value) + "\n")
        self._process.stdin.flush()

    def call(self, tool: str, **arguments: Any) -> tuple[bool, dict[str, Any], str]:
        """Call a tool; returns success, structured content and text."""
        self._write([tool, arguments])
        assert self._process.stdout is not None
        succeeded, answer, text = json.loads(self._process.stdout.readline())
        return bool(succeeded), dict(answer or {}), str(text)

    def do(self, tool: str, **arguments: Any) -> dict[str, Any]:
        """The answer of a call that must succeed."""
        succeeded, answer, text = self.call(tool, **arguments)
        assert succeeded, text
        return answer

    def fail(self, tool: str, **arguments: Any) -> str:
        """The error text of a call that must fail."""
        succeeded, answer, text = self.call(tool, **arguments)
        assert not succeeded, answer
        return text

    def beat(self) -> None:
        """Renew the lease from now on."""
        self._write("beat")

    def rest(self) -> None:
        """Stop renewing the lease."""
        self._write("rest")

    def close(self) -> None:
        """Kill the agent; idempotent."""
        self._process.kill()
        self._process.wait(10.0)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


async def main(url: str) -> None:
    """Serve the test until its end of the pipe closes."""
    beats = anyio.Event()

    async def beat(client: Client) -> None:
        while True:
            await beats.wait()
            await client.call_tool("heartbeat", {})
            await anyio.sleep(BEAT_S)

    headers = {"Authorization": f"Bearer {os.environ['ROBONEURON_TOKEN']}"}
    async with (
        httpx2.AsyncClient(headers=headers, timeout=CALL_S) as http,
        Client(streamable_http_client(url, http_client=http)) as client,
        anyio.create_task_group() as group,
    ):
        group.start_soon(beat, client)
        while line := await anyio.to_thread.run_sync(sys.stdin.readline):
            said = json.loads(line)
            if said == "beat":
                beats.set()
            elif said == "rest":
                beats = anyio.Event()
            else:
                answer = await client.call_tool(*said)
                text = answer.content[0].text if answer.content else ""
                print(
                    json.dumps([not answer.is_error, answer.structured_content, text]), flush=True
                )
        group.cancel_scope.cancel()


if __name__ == "__main__":
    anyio.run(main, sys.argv[1])
