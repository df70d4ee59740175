"""An agent's options cannot make a module send an environment secret to a listener chosen by the
agent.
"""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters, types

pytestmark = pytest.mark.ros
VARIABLE = "THE_ADMINS_TOKEN"
SECRET = "kZ2n8-the-token-of-the-admin-4Qw"
CONFIG = """
[robot]
name = "fr3"
[selection]
{selection}
[http]
tokens = [{{ name = "boss", role = "admin", variable = "THE_ADMINS_TOKEN" }}]
[supervisor]
start_timeout_s = 30.0
state_directory = "{state}"
{more}
"""


class Listener:
    """Accepts connections on loopback and stores the first data."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.port = self._socket.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection:
                connection.settimeout(5.0)
                try:
                    self.received.append(connection.recv(65536))
                except OSError as error:
                    self.received.append(repr(error).encode())

    def close(self) -> None:
        self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(timeout=5.0)


@pytest.fixture
def listener() -> Iterator[Listener]:
    listener = Listener()
    yield listener
    listener.close()


def start(
    environment: dict[str, str],
    folder: Path,
    options: dict[str, Any],
    *,
    selection: str = "",
    more: str = "",
) -> types.CallToolResult:
    """Answer of a stdio server to start_inference with the backend openpi."""
    path = folder / "roboneuron.toml"
    path.write_text(CONFIG.format(selection=selection, state=folder / "state", more=more))
    parameters = StdioServerParameters(
        command=sys.executable,
        args=[
            "-P",
            "-m",
            "roboneuron.cli.main",
            "serve",
            "--config",
            str(path),
            "--log-level",
            "warning",
        ],
        env={**environment, VARIABLE: SECRET},
    )

    async def call() -> types.CallToolResult:
        async with Client(parameters) as client:
            return await client.call_tool(
                "start_inference", {"backend": "openpi", "options": options}
            )

    return anyio.run(call)


def text_of(answer: types.CallToolResult) -> str:
    return " ".join(part.text for part in answer.content if isinstance(part, types.TextContent))


def attack(port: int) -> dict[str, Any]:
    return {
        "profile": "libero",
        "url": f"ws://127.0.0.1:{port}",
        "api_key_variable": VARIABLE,
        "allow_insecure_key": True,
        "start_timeout_s": 3.0,
    }


def test_options_that_name_a_host_and_a_secret_are_refused(
    environment: dict[str, str], tmp_path: Path, listener: Listener
) -> None:
    answer = start(environment, tmp_path, attack(listener.port))
    assert listener.received == []
    assert answer.is_error
    assert answer.meta is not None
    assert answer.meta["roboneuron/error"]["code"] == "refused"
    for option in ("url", "api_key_variable", "allow_insecure_key"):
        assert f"plugins.openpi.{option}" in text_of(answer)
    assert "profile" not in text_of(answer)


def test_a_server_token_is_not_in_the_environment_of_modules(
    environment: dict[str, str], tmp_path: Path, listener: Listener
) -> None:
    more = (
        f'[plugins.openpi]\nurl = "ws://127.0.0.1:{listener.port}"\napi_key_variable = '
        f'"{VARIABLE}"\n'
    )
    answer = start(environment, tmp_path, {"profile": "libero", "start_timeout_s": 3.0}, more=more)
    assert answer.is_error
    assert f"The environment variable '{VARIABLE}' (api_key_variable) is not set." in text_of(
        answer
    )
    assert listener.received == []


@pytest.mark.exhaustive
def test_an_admin_may_set_what_the_configuration_lists(
    environment: dict[str, str], tmp_path: Path, listener: Listener
) -> None:
    options = {
        "profile": "libero",
        "url": f"ws://127.0.0.1:{listener.port}",
        "start_timeout_s": 3.0,
    }
    answer = start(environment, tmp_path, options, selection='agent_options = ["openpi.url"]')
    assert answer.is_error  # the listener is no policy server
    assert listener.received
    assert all(SECRET.encode() not in data for data in listener.received)
