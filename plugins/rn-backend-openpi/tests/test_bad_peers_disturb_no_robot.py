"""Peers of a policy server that are unknown, of another version, silent, numerous or send
nonsense.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from policy_servers import (
    PASSING,
    Robot,
    Serve,
    answers,
    fail_accepts,
    link_of,
    pair,
    said_to,
)

from rn_backend_openpi import listener as listener_module
from rn_backend_openpi import processes as processes_module
from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.description import LOADING, ServerDescription
from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.security import authorization
from rn_backend_openpi.server_options import PolicyServerOptions
from rn_backend_openpi.session import receive
from rn_backend_openpi.status_page import ask_status
from rn_backend_openpi.wire import pack
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


def admitted(port: int, token: Path) -> tuple[PolicyConnection, ServerDescription]:
    """A robot with arbitrary behaviour."""
    connected = socket.create_connection(("127.0.0.1", port), 20.0)
    headers = {"Authorization": authorization(token.read_text().strip())}
    connection = PolicyConnection(connected, "ws://localhost/", headers)
    until_s = time.monotonic() + 10.0
    connection.open(until_s)
    return connection, ServerDescription.of(receive(connection, until_s))


@pytest.mark.exhaustive
def test_robots_that_send_nonsense_are_left_without_harm(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve(keys="token")
    token = tmp_path / "token"
    one = robot(server.address, token_file=str(token))
    port, until_s = server.port, time.monotonic() + 60.0
    for nonsense in (
        lambda first: b"\xff" * 36,
        lambda first: pack({RESERVED: {"number": first - 1, "clock_ns": 0}}),
        lambda first: pack({RESERVED: {"number": first}}),
        lambda first: pack({RESERVED: {"number": first, "clock_ns": 0, "robot": 7}}),
        lambda first: pack({}),
        lambda first: b"\x91" * 1000,
    ):
        connection, welcome = admitted(port, token)
        with closing(connection):
            connection.send(nonsense(welcome.number + 1), until_s)
            assert isinstance(connection.receive(until_s), str)
            with pytest.raises(ConnectionError, match="closed"):
                connection.receive(until_s)
    connection, welcome = admitted(port, token)
    own = {"number": welcome.number + 1, "clock_ns": 0, "left_s": 5.0}
    with closing(connection):
        connection.send(pack({RESERVED: own}), until_s)
        told = receive(connection, until_s)[RESERVED]
        assert (told["number"], told["error"]) == (welcome.number + 1, "invalid_input")
        connection.send(pack({RESERVED: own}), until_s)  # a repetition
        assert "was replayed" in str(connection.receive(until_s))
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
def front(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PolicyServer]:
    """A server in this process with a short time limit, without a model."""
    monkeypatch.setattr(listener_module, "HANDSHAKE_S", 0.5)
    monkeypatch.setattr(ModelProcess, "start", lambda process: None)
    (tmp_path / "run").mkdir(mode=0o700)
    listen = {"port": 0, "keys": "token", "token_file": str(tmp_path / "token")}
    options = PolicyServerOptions.model_validate(
        {"listen": listen, "models": {"only": {"backend": "reflex"}}}
    )
    server = PolicyServer(options, tmp_path / "run", "front")
    thread = threading.Thread(target=server.run)
    thread.start()
    assert server.has_begun.wait(30.0)
    yield server
    server.stop()
    thread.join(60.0)


def test_who_stalls_before_it_is_admitted_is_left(front: PolicyServer) -> None:
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as silent:
        assert silent.recv(1) == b""
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as slow, suppress(OSError):
        for byte in b"GET / HTTP/1.1\r\n" * 10:  # slow single bytes are no handshake
            slow.send(bytes([byte]))
            time.sleep(0.05)
    wait_until(lambda: front.status()["refused_connections"] == 2, 20.0, "both are left")


def test_a_robot_is_told_when_there_is_no_model(front: PolicyServer, tmp_path: Path) -> None:
    connection, welcome = admitted(front.port, tmp_path / "token")
    with closing(connection):
        assert welcome.state == LOADING
        with pytest.raises(ConnectionError, match="not ready"):
            connection.receive(time.monotonic() + 10.0)


def test_a_balancer_is_told_when_a_model_is_not_ready(front: PolicyServer) -> None:
    heard = said_to(front.port, b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
    assert heard.startswith(b"HTTP/1.1 503 ")


def test_robots_come_in_after_connections_that_were_lost(
    front: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_accepts(monkeypatch, *PASSING)
    for _ in range(2):
        connection, welcome = admitted(front.port, tmp_path / "token")
        connection.close()
        assert welcome.state == LOADING
        assert ask_status(front.path)["models"].keys() == {"only"}


def test_the_status_is_told_after_one_that_could_not_be(
    front: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, errors = front.status, [KeyError("clients")]

    def failing() -> Document:
        if errors:
            raise errors.pop()
        return status()

    monkeypatch.setattr(front, "status", failing)
    with pytest.raises(NotReadyError):
        ask_status(front.path)
    assert ask_status(front.path)["models"].keys() == {"only"}


@pytest.mark.parametrize("told", [{}, {"state": "failed", "pid": 1, "error": {}}, {"state": 7}])
def test_a_status_that_cannot_be_read_ends_no_supervision(
    front: PolicyServer, monkeypatch: pytest.MonkeyPatch, told: Document
) -> None:
    monkeypatch.setattr(processes_module, "page", lambda path, timeout_s: told)
    assert not front.models["only"]._look(SimpleNamespace(pid=1))  # type: ignore[arg-type]
