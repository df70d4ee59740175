"""Connections to a shared server that are silent, numerous, of another version or send nonsense."""

from __future__ import annotations

import json
import os
import resource
import socket
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from policy_servers import (
    PASSING,
    SEEN,
    Robot,
    answers,
    fail_accepts,
    fail_one_thread,
)

from rn_backend_shared import server as server_module
from rn_backend_shared.frames import VERSION, FrameKind, Header
from rn_testing.waiting import wait_until

pytestmark = pytest.mark.timeout(200)


def test_nonsense_on_the_socket_disturbs_nobody(served: Robot, tmp_path: Path) -> None:
    one = served()
    (path,) = (tmp_path / "run").glob("*.sock")
    body = json.dumps([{"observation": {}}, []]).encode()
    request = Header(FrameKind.REQUEST, 1, document_bytes=len(body)).pack()
    deep = b"[" * 100_000
    for nonsense in (
        b"\xff" * 64,
        b"GET / HTTP/1.1\r\n\r\n" * 2,
        request + body,
        request[:-1],
        Header(FrameKind.REQUEST, 1, document_bytes=len(deep)).pack() + deep,
        2 * (request + body),
        Header(FrameKind.REQUEST, 1, array_bytes=1 << 31).pack(),
        Header(FrameKind.ANSWER, 1).pack(),
    ):
        with socket.socket(socket.AF_UNIX) as wild:
            wild.settimeout(30.0)
            wild.connect(str(path))
            wild.sendall(nonsense)
            wild.shutdown(socket.SHUT_WR)
            while wild.recv(4096):
                pass
    assert answers(one)
    assert threading.active_count() < 50


def test_a_server_of_another_version_is_refused_in_words(
    served: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with socket.socket(socket.AF_UNIX) as newer:
        newer.settimeout(30.0)
        newer.connect(str(path))
        hello = bytearray(Header(FrameKind.HELLO).pack())
        hello[4] = VERSION + 1
        newer.sendall(hello)
        newer.shutdown(socket.SHUT_WR)  # otherwise it is closed after the time for a first request
        told = b""
        while part := newer.recv(4096):
            told += part
    assert f"version {VERSION + 1}".encode() in told
    assert f"version {VERSION}".encode() in told


def test_connections_that_say_nothing_keep_no_robot_out(served: Robot, tmp_path: Path) -> None:
    one = served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with ExitStack() as stack:
        crowd = [stack.enter_context(socket.socket(socket.AF_UNIX)) for _ in range(200)]
        for silent in crowd:
            silent.connect(str(path))
        assert served().predict(SEEN).metrics["shared.batch"] == 1.0
        assert one.predict(SEEN).actions.size
        crowd[0].settimeout(20)
        assert crowd[0].recv(1) == b""  # the oldest one was closed


def test_a_connection_without_a_first_request_ends(
    served: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "_FIRST_S", 0.05)
    served()
    (path,) = (tmp_path / "run").glob("*.sock")
    with socket.socket(socket.AF_UNIX) as silent:
        silent.settimeout(20)
        silent.connect(str(path))
        assert silent.recv(1) == b""


def test_a_server_without_handles_serves_again_when_it_has_some(
    served: Robot, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = served()
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
            wait_until(lambda: "cannot connect" in caplog.text, 20)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert served().predict(SEEN).actions.size
    assert caplog.text.count("cannot connect") < 5
    assert "Traceback" not in caplog.text


def test_robots_come_in_after_connections_that_were_lost(
    served: Robot, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    served()
    fail_accepts(monkeypatch, *PASSING)
    for _ in range(2):  # the first one is taken by the accept that had begun before
        assert answers(served())
    assert caplog.text.count("A robot cannot connect: the connection was lost.") == len(PASSING)


def test_robots_come_in_after_a_thread_that_could_not_start(
    served: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    served()
    (path,) = (tmp_path / "run").glob("*.sock")
    fail_one_thread(monkeypatch)
    with socket.socket(socket.AF_UNIX) as refused:
        refused.settimeout(20.0)
        refused.connect(str(path))
        assert refused.recv(1) == b""
    assert answers(served())
    assert "A robot cannot connect: can't start new thread." in caplog.text
