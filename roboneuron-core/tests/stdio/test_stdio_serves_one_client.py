"""The transport serves the client on the descriptors that it is lent, and ends with it."""

from __future__ import annotations

import json
import os
import pty

import anyio
import pytest

from roboneuron.feature import Application
from roboneuron.server.host import Host

HELLO = {
    "jsonrpc": "2.0",
    "id": 1,
    "method": "initialize",
    "params": {
        "protocolVersion": "2025-06-18",
        "capabilities": {},
        "clientInfo": {"name": "wire", "version": "1"},
    },
}


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Noted instead of the alarm that ends this process."""
    noted: list[str] = []
    monkeypatch.setattr(Host, "end_soon", staticmethod(lambda: noted.append("soon")))
    return noted


@pytest.mark.parametrize("is_told_to_leave", [False, True])
def test_it_serves_until_the_client_leaves_or_it_is_told_to(
    application: Application, ends: list[str], is_told_to_leave: bool
) -> None:
    server_in, client_out = os.pipe()
    client_in, server_out = os.pipe()
    serve = application.listen((server_in, server_out))

    async def scenario() -> None:
        leave = anyio.Event()
        with anyio.fail_after(30):
            async with anyio.create_task_group() as group:
                group.start_soon(serve, leave)
                os.write(client_out, json.dumps(HELLO).encode() + b"\n")
                answer = await anyio.to_thread.run_sync(os.read, client_in, 65536)
                assert json.loads(answer)["result"]["serverInfo"]["name"] == "roboneuron"
                if is_told_to_leave:
                    leave.set()
                else:
                    os.close(client_out)

    anyio.run(scenario)
    assert ends == ([] if is_told_to_leave else ["soon"])


def test_a_person_at_a_terminal_is_told_who_is_waited_for(
    application: Application, capsys: pytest.CaptureFixture[str]
) -> None:
    person, terminal = pty.openpty()
    application.listen((terminal, terminal))
    text = capsys.readouterr().err
    assert "waits for an MCP client on standard input, which is this terminal" in text
    assert "roboneuron run" in text
    os.close(person)
    os.close(terminal)


def test_a_client_is_told_nothing(
    application: Application, capsys: pytest.CaptureFixture[str]
) -> None:
    reading, writing = os.pipe()
    application.listen((reading, writing))
    assert capsys.readouterr().err == ""
    os.close(reading)
    os.close(writing)
