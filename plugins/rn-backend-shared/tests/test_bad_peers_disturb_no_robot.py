"""Peers of a policy server that are unknown, of another version, silent, numerous or send
nonsense.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from policy_servers import (
    PASSING,
    Robot,
    Serve,
    answers,
    fail_accepts,
    fail_one_thread,
    link_of,
    pair,
    said_to,
)

from rn_backend_shared import front as front_module
from rn_backend_shared import processes as processes_module
from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.frames import HEADER_BYTES, VERSION, Document, FrameKind, Header
from rn_backend_shared.front import PolicyServer
from rn_backend_shared.options import PolicyServerOptions
from rn_backend_shared.processes import ModelProcess, ask_status
from rn_backend_shared.session import FAILED, Welcome
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
    hello = Header(FrameKind.HELLO).pack() + b"[{}, []]"
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
    assert server.status()["refused_connections"] >= 5


def test_a_peer_of_another_version_is_told_both(serve: Serve, robot: Robot, tmp_path: Path) -> None:
    server = serve()
    folder = link_of(tmp_path / "robot")
    machine = read_machine(folder)
    assert machine is not None
    newer = bytearray(Header(FrameKind.HELLO).pack())
    newer[4] = VERSION + 1
    heard = said_to(server.port, bytes(newer), tls_context(machine, folder, "gpu"))
    assert f"version {VERSION + 1}".encode() in heard
    assert f"version {VERSION}:".encode() in heard


def admitted(port: int, token: Path) -> tuple[socket.socket, FrameChannel, int]:
    """A robot with arbitrary behaviour, and the number of its first request."""
    raw = socket.create_connection(("127.0.0.1", port), 20.0)
    channel = FrameChannel(raw)
    channel.send(Header(FrameKind.HELLO), {"token": token.read_text().strip()}, 10.0)
    told = channel.receive(time.monotonic() + 10.0)
    assert told.document()["state"] == "ready"
    return raw, channel, told.header.number + 1


def test_robots_that_send_nonsense_are_left_without_harm(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve(keys="token")
    token = tmp_path / "token"
    one = robot(server.address, token_file=str(token))
    port = server.port
    for nonsense in (
        lambda first: b"\xff" * HEADER_BYTES,
        lambda first: Header(FrameKind.REQUEST, first - 1).pack(),
        lambda first: Header(FrameKind.ANSWER, first).pack(),
        lambda first: Header(FrameKind.STATUS).pack(),
        lambda first: Header(FrameKind.REQUEST, first, array_bytes=(1 << 25) + 1).pack(),
        lambda first: Header(FrameKind.REQUEST, first, document_bytes=1 << 18).pack() + b"[",
    ):
        raw, channel, first = admitted(port, token)
        raw.sendall(nonsense(first))
        raw.shutdown(socket.SHUT_WR)
        with suppress(OSError):
            while raw.recv(4096):
                pass
        channel.close()
    raw, channel, first = admitted(port, token)
    for number in (first, first):  # the second one is a repetition
        channel.send(Header(FrameKind.REQUEST, number, 0, 5.0), {"observation": {}}, 5.0)
    told = channel.receive(time.monotonic() + 10.0)
    assert told.header.number == first
    assert told.document()["error"] == "invalid_input"
    with pytest.raises(OSError, match="closed"):
        channel.receive(time.monotonic() + 10.0)
    channel.close()
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
                silent.send(b"\x16\x03\x01" if index % 2 else b"RNPI")
            crowd.append(stack.enter_context(silent))
            if len(crowd) > 500:
                crowd.pop(0).close()
            if index % 500 == 0:
                answered += answers(one)
        assert answered == 20, "who is connected is served"
        assert answers(robot(server.address, **options)), "a new robot comes in"
    status = server.status()
    assert status["refused_connections"] >= 9000
    threads = len(list(Path(f"/proc/{server.pid}/task").iterdir()))
    assert threads < 600


@pytest.fixture
def front(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PolicyServer]:
    """A server in this process with short time limits, without a model."""
    monkeypatch.setattr(front_module, "_FRAME_S", 0.3)
    monkeypatch.setattr(front_module, "_ADMIT_S", 0.5)
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


def test_who_stalls_is_left_before_and_after_it_was_admitted(
    front: PolicyServer, tmp_path: Path
) -> None:
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as silent:
        assert silent.recv(1) == b""
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as slow, suppress(OSError):
        for byte in Header(FrameKind.HELLO).pack() * 10:  # slow single bytes are no introduction
            slow.send(bytes([byte]))
            time.sleep(0.05)
    wait_until(lambda: front.status()["refused_connections"] == 2, 20.0, "both are left")
    raw = socket.create_connection(("127.0.0.1", front.port), 20.0)
    channel = FrameChannel(raw)
    token = (tmp_path / "token").read_text().strip()
    channel.send(Header(FrameKind.HELLO), {"token": token}, 10.0)
    assert channel.receive(time.monotonic() + 10.0).document()["state"] == "loading"
    wait_until(lambda: front.status()["robots"] == 1, 20.0)
    raw.sendall(Header(FrameKind.REQUEST, 1, 0, 5.0, 1000).pack())
    with pytest.raises(OSError, match="closed"):
        channel.receive(time.monotonic() + 20.0)
    channel.close()
    wait_until(lambda: front.status()["robots"] == 0, 20.0)


def test_a_robot_is_told_when_there_is_no_model(front: PolicyServer, tmp_path: Path) -> None:
    channel = FrameChannel(socket.create_connection(("127.0.0.1", front.port), 20.0))
    token = (tmp_path / "token").read_text().strip()
    channel.send(Header(FrameKind.HELLO), {"token": token}, 10.0)
    first = channel.receive(time.monotonic() + 10.0).header.number + 1
    channel.send(Header(FrameKind.REQUEST, first, 77, 5.0), {"observation": {}}, 5.0)
    told = channel.receive(time.monotonic() + 10.0)
    assert (told.header.number, told.header.clock_ns) == (first, 77)
    assert told.document()["error"] == "not_ready"
    channel.close()
    assert front.status()["models"]["only"]["lost"] == 1


def greeted(front: PolicyServer, folder: Path) -> bool:
    """True if the server welcomes a robot."""
    channel = FrameChannel(socket.create_connection(("127.0.0.1", front.port), 20.0))
    token = (folder / "token").read_text().strip()
    try:
        channel.send(Header(FrameKind.HELLO), {"token": token}, 10.0)
        told = channel.receive(time.monotonic() + 10.0)
    finally:
        channel.close()
    return bool(told.document()["state"] == "loading")


def test_robots_come_in_after_connections_that_were_lost(
    front: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_accepts(monkeypatch, *PASSING)
    for _ in range(2):  # the first one is taken by the accept that had begun before
        assert greeted(front, tmp_path)
        assert ask_status(front.path)["models"].keys() == {"only"}


def test_robots_come_in_after_a_thread_that_could_not_start(
    front: PolicyServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_one_thread(monkeypatch)
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as refused:
        assert refused.recv(1) == b""
    assert greeted(front, tmp_path)
    assert front.status()["refused_connections"] == 1


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


def test_a_failure_that_cannot_be_read_ends_no_supervision(
    front: PolicyServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    process = front.models["only"].processes[0]
    ends = socket.socketpair()
    told = Welcome(state=FAILED, pid=1, failure={})
    monkeypatch.setattr(processes_module, "_connect", lambda path: (FrameChannel(ends[0]), told))
    with ends[1]:
        assert not process._look(SimpleNamespace(pid=1))  # type: ignore[arg-type]
