"""However the server ends, its modules end with it; and its stdout only ever contains JSON-RPC."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from rn_testing.waiting import wait_until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
ServeCommand = Callable[..., list[str]]
PATIENCE_S = 25.0
"""Two seconds on an idle machine; the bound only distinguishes a slow end from a hang."""


class Wire:
    """Hand-written JSON-RPC over a server's pipes; records all of its stdout."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.lines: list[bytes] = []
        self._number = 0

    def request(self, method: str, params: dict[str, Any]) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        self.send(method, params)
        while True:
            answer = json.loads(self.receive())
            if answer.get("id") == self._number:
                return answer  # type: ignore[no-any-return]

    def send(self, method: str, params: dict[str, Any]) -> None:
        """Send a request."""
        self._number += 1
        self._write({"jsonrpc": "2.0", "id": self._number, "method": method, "params": params})

    def receive(self) -> bytes:
        """The next line of any kind."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, "the server has closed its stdout"
        self.lines.append(line)
        return line

    def shake_hands(self) -> None:
        """The handshake of the 2025 protocol."""
        client = {"name": "wire", "version": "1"}
        self.request(
            "initialize",
            {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": client},
        )
        self._write({"jsonrpc": "2.0", "method": "notifications/initialized"})

    def call(self, name: str, **arguments: Any) -> dict[str, Any]:
        """Structured content of a tool call that must succeed."""
        result = self.request("tools/call", {"name": name, "arguments": arguments})["result"]
        assert not result.get("isError"), result
        return result["structuredContent"]  # type: ignore[no-any-return]

    def _write(self, message: dict[str, Any]) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(message).encode() + b"\n")
        self.process.stdin.flush()


@contextmanager
def serving(command: list[str], environment: dict[str, str]) -> Iterator[Wire]:
    process = subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        yield Wire(process)
    finally:
        process.kill()
        process.wait(5)
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            with suppress(BrokenPipeError):
                pipe.close()


def is_gone(pid: int) -> bool:
    """True if there is no such process, or only a zombie that its new parent has not reaped yet."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.parametrize(
    ("end", "is_frozen"),
    [
        # in the cases below one of the two modules is frozen, the other ends as here
        pytest.param("stdin", False, marks=pytest.mark.slow),
        ("stdin", True),
        ("SIGTERM", False),
        pytest.param("SIGINT", False, marks=pytest.mark.exhaustive),
        pytest.param("SIGKILL", False, marks=pytest.mark.slow),
        ("SIGKILL", True),
    ],
    ids=["stdin", "stdin-frozen", "SIGTERM", "SIGINT", "SIGKILL", "SIGKILL-frozen"],
)
def test_modules_end_with_the_server(
    serve_command: ServeCommand, server_environment: dict[str, str], end: str, is_frozen: bool
) -> None:
    """Even a frozen one: a stopped process does not receive its death signal by itself."""
    with serving(serve_command(), server_environment) as wire:
        wire.shake_hands()
        pids = [wire.call("start_robot")["pid"], wire.call("start_perception")["pid"]]
        if is_frozen:
            os.kill(pids[1], signal.SIGSTOP)
        ended_s = time.monotonic()
        if end == "stdin":
            assert wire.process.stdin is not None
            wire.process.stdin.close()
        else:
            wire.process.send_signal(getattr(signal, end))
        code = wire.process.wait(PATIENCE_S)
        wait_until(lambda: all(is_gone(pid) for pid in pids), PATIENCE_S, "all modules are gone")
        print(f"{end}: everything gone after {time.monotonic() - ended_s:.2f} s")
        assert code == (-9 if end == "SIGKILL" else 0)


def test_a_client_that_leaves_during_a_start_is_not_waited_for(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    with serving(serve_command(source="silent", start_timeout_s=60.0), server_environment) as wire:
        wire.shake_hands()
        meta = {"progressToken": 1}
        wire.send("tools/call", {"name": "start_perception", "arguments": {}, "_meta": meta})
        while b"first output" not in wire.receive():
            pass
        assert wire.process.stdin is not None
        wire.process.stdin.close()
        started_s = time.monotonic()
        assert wire.process.wait(PATIENCE_S) == 0
        assert time.monotonic() - started_s < PATIENCE_S
        children = subprocess.run(
            ["ps", "--ppid", str(wire.process.pid)], capture_output=True, text=True, check=False
        )
        assert "python" not in children.stdout


@pytest.mark.slow
@pytest.mark.parametrize("end", ["stdin", "SIGTERM"])
def test_what_hangs_on_the_way_out_keeps_neither_modules_nor_the_server(
    serve_command: ServeCommand, server_environment: dict[str, str], end: str
) -> None:
    with serving(serve_command(), server_environment | {"TEST_FEATURE_LINGERS": "1"}) as wire:
        wire.shake_hands()
        pid = wire.call("start_robot")["pid"]
        if end == "stdin":
            assert wire.process.stdin is not None
            wire.process.stdin.close()
        else:
            wire.process.send_signal(signal.SIGTERM)
        wait_until(lambda: is_gone(pid), PATIENCE_S, "the module is gone")
        assert wire.process.poll() is None, "it hangs"
        assert wire.process.wait(2 * PATIENCE_S) == -signal.SIGALRM


def test_stdout_carries_json_rpc_only_and_tools_come_soon(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    started_s = time.monotonic()
    with serving(serve_command(), server_environment) as wire:
        wire.shake_hands()
        tools = wire.request("tools/list", {})["result"]["tools"]
        print(f"{len(tools)} tools listed {time.monotonic() - started_s:.2f} s after the spawn")
        wire.call("list_backends")
        wire.call("start_robot")
        wire.call("stop_robot")
        assert wire.process.stdin is not None
        wire.process.stdin.write(b"this is not JSON\n\n\xff\xfe\n")
        wire.process.stdin.flush()
        wire.call("get_status")
        wire.process.stdin.close()
        assert wire.process.stdout is not None
        wire.lines += wire.process.stdout.readlines()
        assert wire.process.wait(PATIENCE_S) == 0
    assert len(wire.lines) >= 6
    for line in wire.lines:
        assert json.loads(line)["jsonrpc"] == "2.0"


def test_a_configuration_that_names_what_is_not_installed_is_refused_at_once(
    serve_command: ServeCommand, server_environment: dict[str, str]
) -> None:
    command = serve_command(source="webcam")
    done = subprocess.run(
        command,
        env=server_environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert "There is no perception 'webcam'." in done.stderr
    assert "Traceback" not in done.stderr
