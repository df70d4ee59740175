"""Peers of a policy server that are unknown, of another version, silent, numerous or send
nonsense.
"""

from __future__ import annotations

import os
import resource
import socket
import ssl
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from openpi_clients import SLACK_S, http_get, open_client
from policy_servers import (
    PASSING,
    SEEN,
    Robot,
    Serve,
    answers,
    fail_accepts,
    link_of,
    pair,
    said_to,
)
from websockets.exceptions import ConnectionClosed

from rn_backend_openpi import listener as listener_module
from rn_backend_openpi import processes as processes_module
from rn_backend_openpi.description import LOADING
from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.security import authorization
from rn_backend_openpi.statistics import ask_status
from rn_link.machine import read_machine
from rn_link.tls import tls_context
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError

pytestmark = pytest.mark.timeout(200)


def test_strangers_learn_nothing_and_disturb_nobody(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve()
    one = robot(server.address)
    port = server.port
    hello = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"
    for sent in (b"", b"\xff" * 64, b"GET / HTTP/1.1\r\n\r\n", hello):
        heard = said_to(port, sent) if sent else b""
        # at most a TLS alert, which says that this was no handshake
        assert len(heard) <= 7, heard
    nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    nobody.check_hostname = False
    nobody.verify_mode = ssl.CERT_NONE
    assert said_to(port, hello, nobody) == b""
    # a machine that is paired with another one
    pair(tmp_path / "other", tmp_path / "third")
    machine = read_machine(link_of(tmp_path / "other"))
    assert machine is not None
    foreign = tls_context(machine, link_of(tmp_path / "other"), "gpu")
    foreign.verify_mode = ssl.CERT_NONE
    assert said_to(port, hello, foreign) == b""
    assert answers(one)


@pytest.mark.slow
@pytest.mark.parametrize("keys", ["link", "token"])
def test_ten_thousand_connections_keep_no_robot_out(
    serve: Serve, robot: Robot, tmp_path: Path, keys: str
) -> None:
    server = serve(keys=keys)
    options = {"token_file": str(tmp_path / "token")} if keys == "token" else {}
    one = robot(server.address, **options)
    port, answered = server.port, 0
    with ExitStack() as stack:
        crowd: list[socket.socket] = []
        for index in range(10_000):
            silent = socket.socket()
            silent.settimeout(10.0)
            with suppress(OSError):
                silent.connect(("127.0.0.1", port))
                silent.send(b"\x16\x03\x01" if index % 2 else b"GET ")
            crowd.append(stack.enter_context(silent))
            if len(crowd) > 500:
                crowd.pop(0).close()
            if index % 500 == 0:
                answered += answers(one)
        assert answered == 20, "who is connected is served"
        assert answers(robot(server.address, **options)), "a new robot comes in"
    if keys == "token":  # failed handshakes of TLS are not counted
        assert server.status()["refused_connections"] >= 9000
    threads = len(list(Path(f"/proc/{server.pid}/task").iterdir()))
    assert threads < 600


@pytest.fixture
def hasty(
    front: Callable[..., PolicyServer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> PolicyServer:
    """A server without a model and with a short time limit."""
    monkeypatch.setattr(listener_module, "HANDSHAKE_S", 0.5)
    return front(keys="token", token_file=str(tmp_path / "token"))


def test_who_stalls_before_it_is_admitted_is_left(hasty: PolicyServer) -> None:
    with socket.create_connection(("127.0.0.1", hasty.port), 20.0) as silent:
        assert silent.recv(1) == b""
    with socket.create_connection(("127.0.0.1", hasty.port), 20.0) as slow, suppress(OSError):
        for byte in b"GET / HTTP/1.1\r\n" * 10:  # slow single bytes are no handshake
            slow.send(bytes([byte]))
            time.sleep(0.05)
    wait_until(lambda: hasty.status()["refused_connections"] == 2, 20.0, "both are left")


def test_a_robot_and_a_balancer_are_told_when_there_is_no_model_after_lost_connections(
    hasty: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    headers = {"Authorization": authorization((tmp_path / "token").read_text().strip())}
    url = f"ws://127.0.0.1:{hasty.port}"
    fail_accepts(monkeypatch, *PASSING)
    for _ in range(2):
        with open_client(url, additional_headers=headers) as connection:
            assert connection.metadata[RESERVED]["state"] == LOADING
            with pytest.raises(ConnectionClosed, match="not ready"):
                connection.recv(timeout=SLACK_S)
        assert ask_status(hasty.path)["models"].keys() == {"only"}
    assert http_get(url, "/healthz")[0] == 503


def test_the_status_is_told_after_one_that_could_not_be(
    hasty: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, errors = hasty.status, [KeyError("clients")]

    def failing() -> Document:
        if errors:
            raise errors.pop()
        return status()

    monkeypatch.setattr(hasty, "status", failing)
    with pytest.raises(NotReadyError):
        ask_status(hasty.path)
    assert ask_status(hasty.path)["models"].keys() == {"only"}


@pytest.mark.parametrize("told", [{}, {"state": "failed", "pid": 1, "error": {}}, {"state": 7}])
def test_a_status_that_cannot_be_read_ends_no_supervision(
    hasty: PolicyServer, monkeypatch: pytest.MonkeyPatch, told: Document
) -> None:
    monkeypatch.setattr(processes_module, "page", lambda path, timeout_s: told)
    assert not hasty.models["only"]._look(SimpleNamespace(pid=1))  # type: ignore[arg-type]


def test_a_server_without_handles_serves_again_when_it_has_some(
    served: Robot, tmp_path: Path
) -> None:
    one = served()
    assert one.predict(SEEN).actions.size  # what is imported on demand is there
    (path,) = (tmp_path / "run").glob("*.sock")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as stack:
        crowd = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(5)]
        next_one = os.dup(0)
        os.close(next_one)
        resource.setrlimit(resource.RLIMIT_NOFILE, (next_one, before[1]))
        try:
            for refused in crowd:
                refused.connect(str(path))
            assert one.predict(SEEN).actions.size  # a connected robot is still served
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert served().predict(SEEN).actions.size
