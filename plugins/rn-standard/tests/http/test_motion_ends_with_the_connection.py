"""A client over HTTP that is lost while its call moves the robot: it is stopped, in both eras of
the protocol.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from rn_testing.waiting import wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
CONFIG = """
[server]
transport = "http"
[http]
port = {port}
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
stop_message = "zero"
repeat_hz = 20.0
"""
CALL = {
    "name": "publish_velocity",
    "arguments": {"message": {"linear": {"x": 0.3}}, "duration_s": 60},
    "_meta": {"progressToken": 1},
}
HEADERS = {"Content-Type": "application/json", "Accept": "application/json, text/event-stream"}


@pytest.fixture
def url(
    serve_command: Callable[..., list[str]], server_environment: dict[str, str], tmp_path: Path
) -> Iterator[str]:
    command = serve_command()
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    configuration = Path(command[command.index("--config") + 1])
    configuration.write_text(configuration.read_text() + CONFIG.format(port=port))

    def is_open() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", port)) == 0

    with (tmp_path / "server.log").open("wb") as log:
        process = subprocess.Popen(
            command, env=server_environment, stdin=subprocess.DEVNULL, stderr=log
        )
    try:
        wait_until(lambda: process.poll() is not None or is_open(), 60.0, "the server listens")
        assert process.poll() is None, (tmp_path / "server.log").read_text()
        yield f"http://127.0.0.1:{port}/mcp"
    finally:
        process.kill()
        process.wait(5)


def request(method: str, params: Any, number: int | None = 1) -> bytes:
    message = {"jsonrpc": "2.0", "method": method, "params": params}
    return json.dumps(message if number is None else {**message, "id": number}).encode()


def drive(url: str, headers: dict[str, str], params: dict[str, Any], wheels: Any) -> None:
    """Call, wait until the wheels turn, and cut the connection without a word."""
    with (
        httpx2.Client(timeout=30) as http,
        http.stream(
            "POST", url, headers={**HEADERS, **headers}, content=request("tools/call", params, 2)
        ) as response,
    ):
        assert response.status_code == 200, response.read()
        wait_until(lambda: 0.3 in wheels.speeds, 20.0, "the wheels turn")


def check_stopped(wheels: Any) -> None:
    wait_until(lambda: wheels.speeds[-1] == 0.0, 5.0, "the wheels stand")
    count = len(wheels.speeds)
    threading.Event().wait(0.3)
    assert len(wheels.speeds) == count


def test_a_lost_client_of_a_session_stops_the_robot(url: str, wheels: Any) -> None:
    params = {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "lost", "version": "1"},
    }
    hello = httpx2.post(url, headers=HEADERS, content=request("initialize", params), timeout=30)
    session = {
        "Mcp-Session-Id": hello.headers["mcp-session-id"],
        "MCP-Protocol-Version": "2025-06-18",
    }
    httpx2.post(
        url,
        headers={**HEADERS, **session},
        content=request("notifications/initialized", {}, None),
        timeout=30,
    )
    drive(url, session, CALL, wheels)
    check_stopped(wheels)
    again = httpx2.post(
        url, headers={**HEADERS, **session}, content=request("tools/list", {}, 3), timeout=30
    )
    assert again.status_code == 200, "the session itself goes on"


CLIENT = """
import sys, anyio
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

async def main():
    async with Client(streamable_http_client(sys.argv[1]), mode=sys.argv[2]) as client:
        await client.call_tool("publish_velocity", {"message": {"linear": {"x": 0.3}}, "duration_s": 60})

anyio.run(main)
"""  # noqa: E501


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("mode", ["auto", "legacy"])
def test_a_client_process_that_is_killed_stops_the_robot(url: str, wheels: Any, mode: str) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, url, mode], env=dict(os.environ))
    try:
        wait_until(lambda: 0.3 in wheels.speeds, 30.0, "the wheels turn")
    finally:
        client.kill()
        client.wait(5)
    check_stopped(wheels)
