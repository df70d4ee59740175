"""A machine is admitted only with the six digits that the hub shows."""

from __future__ import annotations

import errno
import json
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from rn_link.machine import Peer, read_machine
from rn_link_pairing import pairing
from rn_link_pairing.keeping import become_hub
from rn_link_pairing.pairing import ATTEMPTS, PairingHub, join, new_code, open_listener
from rn_link_pairing.pake import Exchange, PairingError
from roboneuron import ConfigurationError

CODE, OTHER = "123456", "123457"
PORT = 7500


@pytest.fixture
def hub(tmp_path: Path) -> Path:
    folder = tmp_path / "hub"
    become_hub(folder, "robot", datetime.now(UTC), 365)
    return folder


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made


def in_background(function: Callable[[], Peer]) -> Future[Peer]:
    """Result or exception of the function, which runs on its own thread."""
    future: Future[Peer] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except (ConfigurationError, OSError) as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


def admitting(
    hub: Path, listener: socket.socket, complaints: list[str], limit_s: float = 30.0
) -> Future[Peer]:
    admission = PairingHub(hub, "gpu", address=None, days=90, notify=complaints.append)
    return in_background(lambda: admission.serve(listener, CODE, limit_s))


def test_equal_codes_make_equal_keys_and_others_do_not() -> None:
    member = Exchange(CODE, is_hub=False)
    hub, stranger = Exchange(CODE, is_hub=True), Exchange(OTHER, is_hub=True)
    to_hub, _ = member.keys(hub.share)
    sealed = to_hub.seal(b"hello")
    at_hub, from_hub = hub.keys(member.share)
    assert at_hub.open(sealed) == b"hello"
    for sealer in (from_hub, *stranger.keys(member.share)):
        with pytest.raises(PairingError, match="code is not that"):
            sealer.open(sealed)


IDENTITY = (1).to_bytes(32, "little")
ORDER_2 = (2**255 - 20).to_bytes(32, "little")
"""Points of small order, which would determine the key."""


@pytest.mark.parametrize(
    "share",
    [
        b"",
        b"A",
        b"A" + bytes(31),
        b"A" + bytes(32),
        b"A" + IDENTITY,
        b"A" + ORDER_2,
        b"A" + b"\xff" * 32,
        b"A" + bytes(range(32)),
        b"B" + IDENTITY,
        b"?" + IDENTITY,
        b"A" + bytes(64),
    ],
)
def test_a_share_that_is_none_is_refused(share: bytes) -> None:
    with pytest.raises(PairingError, match="no valid share"):
        Exchange(CODE, is_hub=True).keys(share)


def test_a_share_that_is_sent_back_is_refused() -> None:
    hub = Exchange(CODE, is_hub=True)
    with pytest.raises(PairingError, match="no valid share"):
        hub.keys(b"A" + hub.share[1:])


def test_a_machine_with_the_code_is_admitted(
    hub: Path, listener: socket.socket, tmp_path: Path
) -> None:
    port = listener.getsockname()[1]
    admitted = admitting(hub, listener, [])
    member = tmp_path / "member"
    machine = join(member, "127.0.0.1", port, CODE, PORT)
    assert admitted.result(10.0) == Peer("127.0.0.1", PORT)
    assert machine == read_machine(member)
    assert (machine.name, machine.role, list(machine.peers)) == ("gpu", "member", ["robot"])
    found = read_machine(hub)
    assert found is not None
    assert found.peers == {"gpu": Peer("127.0.0.1", PORT)}
    assert (member / "peers" / "robot.issuer.pem").read_bytes() == (hub / "ca.pem").read_bytes()
    assert not (member / "ca.key").exists(), "no authority leaves the hub"


def test_a_wrong_code_changes_nothing_and_the_right_one_still_works(
    hub: Path, listener: socket.socket, tmp_path: Path
) -> None:
    port = listener.getsockname()[1]
    complaints: list[str] = []
    admitted = admitting(hub, listener, complaints)
    with pytest.raises(ConfigurationError, match="not admitted"):
        join(tmp_path / "member", "127.0.0.1", port, OTHER, PORT)
    assert read_machine(tmp_path / "member") is None
    join(tmp_path / "member", "127.0.0.1", port, CODE, PORT)
    assert admitted.result(10.0).address == "127.0.0.1"
    assert complaints == ["127.0.0.1: the code is not that of the other machine."]


def test_a_code_is_void_after_three_attempts(
    hub: Path, listener: socket.socket, tmp_path: Path
) -> None:
    port = listener.getsockname()[1]
    admitted = admitting(hub, listener, [])
    for _ in range(ATTEMPTS):
        with pytest.raises(ConfigurationError, match="not admitted"):
            join(tmp_path / "member", "127.0.0.1", port, OTHER, PORT)
    with pytest.raises(ConfigurationError, match="3 attempts had a wrong code"):
        admitted.result(10.0)
    found = read_machine(hub)
    assert found is not None
    assert not found.peers


def test_a_peer_that_leaves_after_the_share_has_used_an_attempt(
    hub: Path, listener: socket.socket
) -> None:
    admitted = admitting(hub, listener, [])
    share = Exchange(OTHER, is_hub=False).share
    message = json.dumps({"share": share.hex()}).encode()
    for _ in range(ATTEMPTS):
        with socket.create_connection(listener.getsockname()) as connection:
            connection.sendall(len(message).to_bytes(4, "big") + message)
            connection.recv(1)
    with pytest.raises(ConfigurationError, match="3 attempts"):
        admitted.result(10.0)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        b"\x00\x00\x00\x02[]",
        b"\xff\xff\xff\xff",
        b"\x00\x00\x00\x02{}",
    ],
)
def test_other_traffic_uses_no_attempt(
    hub: Path, listener: socket.socket, tmp_path: Path, content: bytes
) -> None:
    complaints: list[str] = []
    admitted = admitting(hub, listener, complaints)
    for _ in range(2 * ATTEMPTS):
        with socket.create_connection(listener.getsockname()) as connection:
            connection.sendall(content)
    join(tmp_path / "member", "127.0.0.1", listener.getsockname()[1], CODE, PORT)
    assert admitted.result(10.0).port == PORT
    assert len(complaints) == 2 * ATTEMPTS


@pytest.mark.parametrize("count", [4, 100])
@pytest.mark.parametrize("begins", [b"", b"\x00\x00"], ids=["silent", "half a length"])
def test_machines_that_say_nothing_delay_no_other(
    hub: Path, listener: socket.socket, tmp_path: Path, count: int, begins: bytes
) -> None:
    """An attempt may take 10 s."""
    admitted = admitting(hub, listener, [])
    port = listener.getsockname()[1]
    with ExitStack() as silent:
        for _ in range(count):
            one = silent.enter_context(socket.create_connection(("127.0.0.1", port), 5.0))
            one.sendall(begins)
        begun_s = time.monotonic()
        join(tmp_path / "member", "127.0.0.1", port, CODE, PORT)
        assert admitted.result(10.0).port == PORT
        assert time.monotonic() - begun_s < 8.0


def test_the_hub_is_not_added_to_itself(hub: Path) -> None:
    with pytest.raises(ConfigurationError, match="the hub itself"):
        PairingHub(hub, "robot", address=None, days=90, notify=lambda _: None)


class Failing(socket.socket):
    """A listener whose first connections are lost before they are accepted."""

    def __init__(self, fileno: int) -> None:
        super().__init__(fileno=fileno)
        self.errors = [errno.ECONNABORTED, errno.EPROTO]

    def accept(self) -> tuple[socket.socket, Any]:
        if self.errors:
            raise OSError(self.errors.pop(), "lost")
        return super().accept()


def test_a_connection_that_is_lost_before_it_is_accepted_uses_no_attempt(
    hub: Path, listener: socket.socket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pairing, "_PAUSE_S", 0.0, raising=False)
    complaints: list[str] = []
    with Failing(os.dup(listener.fileno())) as failing:
        admitted = admitting(hub, failing, complaints)
        join(tmp_path / "member", "127.0.0.1", listener.getsockname()[1], CODE, PORT)
        assert admitted.result(10.0).port == PORT
    assert [complaint.partition(":")[0] for complaint in complaints] == [
        "A machine cannot connect"
    ] * 2


def test_a_closed_listener_ends_the_pairing(hub: Path, listener: socket.socket) -> None:
    listener.close()
    admission = PairingHub(hub, "gpu", address=None, days=90, notify=lambda _: None)
    with pytest.raises(OSError, match="Bad file descriptor"):
        admission.serve(listener, CODE)


def test_nobody_in_time_is_told_with_what_to_type(hub: Path, listener: socket.socket) -> None:
    with pytest.raises(ConfigurationError, match=r"within 0\.01 s") as caught:
        admitting(hub, listener, [], 0.01).result(10.0)
    assert "roboneuron link add gpu" in str(caught.value)


def test_a_hub_that_is_not_there_is_named(tmp_path: Path, listener: socket.socket) -> None:
    port = listener.getsockname()[1]
    listener.close()
    with pytest.raises(ConfigurationError, match=rf"No hub answers at 127\.0\.0\.1, port {port}"):
        join(tmp_path / "member", "127.0.0.1", port, CODE, PORT)


def test_a_taken_port_is_told(listener: socket.socket) -> None:
    taken = socket.create_server(("0.0.0.0", 0))
    with taken, pytest.raises(ConfigurationError, match="cannot listen on port"):
        open_listener(taken.getsockname()[1])


def test_codes_are_six_digits_and_differ() -> None:
    codes = {new_code() for _ in range(100)}
    assert all(len(code) == 6 and code.isdecimal() for code in codes)
    assert len(codes) > 90
