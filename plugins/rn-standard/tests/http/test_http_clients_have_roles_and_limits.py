"""A real server on a free port of loopback, asked by real clients; modules start in one test
only.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2
import pytest
from mcp import Client
from mcp.client.streamable_http import streamable_http_client

from rn_testing.waiting import wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]
ServeCommand = Callable[..., list[str]]
TOKENS = {role: f"{role}-token-of-this-test" for role in ("viewer", "operator", "admin")}
SERVER = """
[server]
transport = "http"
max_concurrent_calls = 2
reset_emergency_stop = "client"
[http]
port = {port}
max_request_bytes = 20000
[[http.tokens]]
name = "screen"
role = "viewer"
variable = "TEST_VIEWER"
[[http.tokens]]
name = "pendant"
role = "operator"
variable = "TEST_OPERATOR"
[[http.tokens]]
name = "chief"
role = "admin"
variable = "TEST_ADMIN"
"""
HEADERS = {"Content-Type": "application/json", "Accept": "application/json, text/event-stream"}


class HttpServer:
    """A running `roboneuron serve --transport http`."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, log: Path) -> None:
        self.process = process
        self.url = f"http://127.0.0.1:{port}/mcp"
        self.log = log

    def post(
        self, *, token: str | None = TOKENS["admin"], body: bytes | None = None, **headers: str
    ) -> httpx2.Response:
        """One POST by hand: a call of get_status without handshake."""
        sent = {**HEADERS, **headers}
        if token is not None:
            sent["Authorization"] = f"Bearer {token}"
        text = (
            body
            if body is not None
            else json.dumps({"jsonrpc": "2.0", "id": 1, "method": "ping"}).encode()
        )
        return httpx2.post(self.url, headers=sent, content=text, timeout=30, verify=False)


async def with_client(
    server: HttpServer, role: str, work: Callable[[Client], Any], mode: str = "auto"
) -> Any:
    headers = {"Authorization": f"Bearer {TOKENS[role]}"}
    async with (
        httpx2.AsyncClient(headers=headers, timeout=60) as http,
        Client(streamable_http_client(server.url, http_client=http), mode=mode) as client,
    ):
        return await work(client)


def ask(server: HttpServer, role: str, tool: str, mode: str = "auto", **arguments: Any) -> Any:
    """Answer of one call by a client of its own."""
    import anyio

    async def work(client: Client) -> Any:
        return await client.call_tool(tool, arguments)

    return anyio.run(with_client, server, role, work, mode)


def code_of(answer: Any) -> str:
    assert answer.is_error, answer
    return str(answer.meta["roboneuron/error"]["code"])


@contextmanager
def serving(command: list[str], environment: dict[str, str], folder: Path) -> Iterator[HttpServer]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    configuration = Path(command[command.index("--config") + 1])
    configuration.write_text(configuration.read_text() + SERVER.format(port=port))
    log = folder / "server.log"
    words = [word if word != "warning" else "debug" for word in command]
    tokens = {f"TEST_{role.upper()}": token for role, token in TOKENS.items()}
    with log.open("wb") as sink:
        process = subprocess.Popen(
            words, env={**environment, **tokens}, stdin=subprocess.DEVNULL, stderr=sink
        )
    try:
        wait_until(lambda: process.poll() is not None or is_open(port), 60.0, "the server listens")
        assert process.poll() is None, log.read_text()
        yield HttpServer(process, port, log)
    finally:
        process.kill()
        process.wait(5)


def is_open(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def is_gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.fixture(scope="module")
def server(shared_folder: tuple[Path, list[str], dict[str, str]]) -> Iterator[HttpServer]:
    """For tests that leave it as it was: its stop is released, its list of tools the same."""
    folder, command, environment = shared_folder
    with serving(command, environment, folder) as running:
        yield running


def test_requests_without_a_right_are_turned_away(server: HttpServer) -> None:
    assert server.post(token=None).status_code == 401
    refused = server.post(token="not-the-token-of-anybody")
    assert refused.status_code == 401
    assert refused.headers["www-authenticate"].startswith("Bearer")
    assert "bearer token is needed" in refused.json()["error"]["message"]
    assert server.post(token=None, Authorization=f"Basic {TOKENS['admin']}").status_code == 401
    assert server.post(Host="rebound.example").status_code == 421
    assert server.post(Host="rebound.example", token=None).status_code == 421
    assert server.post(Origin="http://rebound.example").status_code == 403
    large = server.post(body=b'{"jsonrpc": "2.0", "id": 1, "method": "' + b"x" * 20000 + b'"}')
    assert (large.status_code, large.text) == (413, "Request body too large")
    assert ask(server, "viewer", "get_status").structured_content["modules"]
    text = server.log.read_text()
    assert not [role for role, token in TOKENS.items() if token in text]


def test_each_role_may_do_what_it_may(server: HttpServer) -> None:
    import anyio

    async def names(client: Client) -> set[str]:
        return {tool.name for tool in (await client.list_tools()).tools}

    seen = {role: anyio.run(with_client, server, role, names) for role in TOKENS}
    assert seen["viewer"] < seen["operator"] < seen["admin"]
    assert seen["admin"] - seen["operator"] == {
        "reset_emergency_stop",
        "expose_endpoint",
        "unexpose_endpoint",
    }
    assert {"get_status", "emergency_stop"} <= seen["viewer"]
    assert not {"start_robot", "set_instruction", "stop_all"} & seen["viewer"]

    refused = ask(server, "viewer", "start_robot")
    assert code_of(refused) == "refused"
    assert "start_robot needs the role 'operator'; screen has 'viewer'" in refused.content[0].text
    for mode in ("auto", "legacy"):
        assert code_of(ask(server, "viewer", "stop_all", mode)) == "refused"
        assert code_of(ask(server, "operator", "reset_emergency_stop", mode)) == "refused"
    assert not ask(server, "viewer", "emergency_stop", reason="seen on the screen").is_error
    assert code_of(ask(server, "operator", "reset_emergency_stop")) == "refused"
    assert not ask(server, "admin", "reset_emergency_stop").is_error


def test_an_admin_exposes_an_endpoint_while_the_server_runs(server: HttpServer) -> None:
    horn = {"name": "horn", "kind": "publish", "topic": "horn", "type": "std_msgs/msg/Bool"}
    assert code_of(ask(server, "operator", "expose_endpoint", **horn)) == "refused"
    made = ask(server, "admin", "expose_endpoint", **horn)
    assert not made.is_error, made.content
    nobody = ask(server, "admin", "publish_horn", message={"data": True}, timeout_s=0)
    assert "has no subscriber" in nobody.content[0].text
    assert not ask(server, "admin", "unexpose_endpoint", "legacy", name="horn").is_error
    assert "There is no tool 'publish_horn'" in ask(server, "admin", "publish_horn").content[0].text


def test_a_session_is_of_one_token(server: HttpServer) -> None:
    client = {"name": "wire", "version": "1"}
    params = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client}
    body = json.dumps(
        {"jsonrpc": "2.0", "id": 1, "method": "initialize", "params": params}
    ).encode()
    opened = server.post(body=body)
    assert opened.status_code == 200
    session = {
        "mcp-session-id": opened.headers["mcp-session-id"],
        "mcp-protocol-version": "2025-06-18",
    }
    assert server.post(token=TOKENS["viewer"], **session).status_code == 404
    assert server.post(**session).status_code == 200


def test_clients_share_one_robot_that_ends_with_the_server(
    serve_command: ServeCommand, server_environment: dict[str, str], tmp_path: Path
) -> None:
    with serving(serve_command(), server_environment, tmp_path) as server:
        pid = ask(server, "operator", "start_robot").structured_content["pid"]
        assert code_of(ask(server, "admin", "start_robot", "legacy")) == "refused"
        modules = ask(server, "viewer", "get_status", "legacy").structured_content["modules"]
        assert [module["pid"] for module in modules if module["module"] == "robot"] == [pid]
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(20) == 0
    wait_until(lambda: is_gone(pid), 5.0, "the module is gone")


@pytest.mark.exhaustive
def test_too_many_calls_at_once_are_refused_but_stops_are_not(
    serve_command: ServeCommand, server_environment: dict[str, str], tmp_path: Path
) -> None:
    import anyio

    async def crowd(client: Client) -> tuple[Any, Any, Any]:
        async with anyio.create_task_group() as group:
            group.start_soon(client.call_tool, "start_perception", {})
            group.start_soon(client.call_tool, "start_robot", {})
            with anyio.fail_after(60):
                while True:
                    third = await client.call_tool("get_status", {})
                    if third.is_error:
                        break
                    await anyio.sleep(0.01)
            stop = await client.call_tool("emergency_stop", {})
            ended = await client.call_tool("stop_perception", {})
            group.cancel_scope.cancel()
        return third, stop, ended

    with serving(
        serve_command(source="silent", start_timeout_s=60.0), server_environment, tmp_path
    ) as server:
        third, stop, ended = anyio.run(with_client, server, "admin", crowd)
    assert code_of(third) == "not_ready"
    assert "2 calls are already running" in third.content[0].text
    # taken, whatever modules that only start say
    assert not stop.is_error or code_of(stop) == "unsafe"
    assert not ended.is_error


def test_the_command_line_talks_to_a_running_server(server: HttpServer) -> None:
    def roboneuron(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "roboneuron.cli.main", *words, "--url", server.url]
        return subprocess.run(
            command,
            env={**os.environ, **variables},
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )

    status = roboneuron("call", "get_status", "--token-variable", "MINE", MINE=TOKENS["viewer"])
    assert (status.returncode, json.loads(status.stdout)["emergency_stop"]) == (0, False), (
        status.stderr
    )
    listed = roboneuron("tools", ROBONEURON_TOKEN=TOKENS["viewer"])
    assert "get_status" in listed.stdout
    assert "start_robot" not in listed.stdout
    wrong = roboneuron("call", "get_status")
    assert wrong.returncode == 2
    assert "refuses the token" in wrong.stderr
    assert "Traceback" not in wrong.stderr
