"""A machine is admitted only with the six digits that the hub shows."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from link_pairs import admit, make_hub
from spake2 import SPAKE2_A, SPAKE2_B

from rn_link import pairing
from rn_link.keys import own_certificate
from rn_link.machine import Peer, read_machine
from rn_link.pairing import ATTEMPTS, PairingHub, join, new_code, open_listener
from rn_link.tls import MOST_HANDSHAKES
from roboneuron import ConfigurationError

CODE, OTHER = "123456", "123457"
SIDES = {"idA": b"roboneuron link member", "idB": b"roboneuron link hub"}
QUICK_S = 8.0
"""Less than the 10 s that an attempt may take."""


class Hub:
    """A hub that admits `gpu` on its own thread.

    Attributes:
        admitted: its result.
        complaints: what its person reads.
    """

    def __init__(self, folder: Path, listener: socket.socket) -> None:
        self.folder = folder
        self.listener = listener
        self.port = int(listener.getsockname()[1])
        self.admitted: Future[str] = Future()
        self.complaints: list[str] = []
        self._thread: threading.Thread | None = None

    def serve(self, limit_s: float = 30.0) -> Hub:
        """Begin."""
        hub = PairingHub(self.folder, "gpu", CODE, self.complaints.append)
        begun = threading.Event()

        async def serve() -> str:
            loop, task = asyncio.get_running_loop(), asyncio.current_task()
            assert task is not None
            self._cancel = lambda: loop.call_soon_threadsafe(task.cancel)
            begun.set()
            return await hub.serve(self.listener, limit_s)

        def run() -> None:
            try:
                self.admitted.set_result(asyncio.run(serve()))
            except (ConfigurationError, OSError) as error:
                self.admitted.set_exception(error)
            except asyncio.CancelledError:
                self.admitted.cancel()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()
        assert begun.wait(10.0)
        return self

    def close(self) -> None:
        """End, with its thread."""
        if self._thread is not None:
            with suppress(RuntimeError):  # its loop has ended
                self._cancel()
            self._thread.join(10.0)
            assert not self._thread.is_alive()

    def connect(self, content: bytes = b"") -> socket.socket:
        """A connection that has sent this."""
        made = socket.create_connection(("127.0.0.1", self.port), 5.0)
        made.sendall(content)
        return made

    def join(self, folder: Path, code: str = CODE) -> None:
        """Pair a member."""
        asyncio.run(join(folder, "127.0.0.1", code, self.port))


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    make_hub(tmp_path / "hub")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        made = Hub(tmp_path / "hub", listener)
        yield made
        made.close()


@pytest.fixture
def member(tmp_path: Path) -> Path:
    return tmp_path / "member"


def line(side: bytes, point: bytes) -> bytes:
    """A message with which an attempt begins."""
    return (side + point).hex().encode() + b"\n"


GUESS = line(SPAKE2_A(OTHER.encode(), **SIDES).start(), b"")
IDENTITY = (1).to_bytes(32, "little")
ORDER_2 = (2**255 - 20).to_bytes(32, "little")
"""Points of small order, which would determine the key."""


def test_a_machine_with_the_code_is_admitted_after_a_wrong_one(hub: Hub, member: Path) -> None:
    hub.serve()
    with pytest.raises(ConfigurationError, match="not admitted"):
        hub.join(member, OTHER)
    assert read_machine(member) is None
    hub.join(member)
    assert hub.admitted.result(10.0) == "127.0.0.1"
    assert hub.complaints == ["127.0.0.1: the code is not that of the other machine."]
    found, own = read_machine(member), read_machine(hub.folder)
    assert found is not None
    assert own is not None
    assert (found.name, found.role) == ("gpu", "member")
    assert found.peers == {"robot": Peer("127.0.0.1", own_certificate(hub.folder))}
    assert own.peers == {"gpu": Peer("127.0.0.1", own_certificate(member))}


@pytest.mark.parametrize("kind", ["wrong", "leaves"])
def test_a_code_is_void_after_three_attempts(hub: Hub, member: Path, kind: str) -> None:
    """Who leaves after the hub's share may have tried a code."""
    hub.serve()
    for _ in range(ATTEMPTS):
        if kind == "wrong":
            with pytest.raises(ConfigurationError, match="not admitted"):
                hub.join(member, OTHER)
        else:
            with hub.connect(GUESS) as connection:
                connection.recv(1)
    with pytest.raises(ConfigurationError, match="3 attempts had a wrong code"):
        hub.admitted.result(10.0)
    found = read_machine(hub.folder)
    assert found is not None
    assert not found.peers


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        b"x" * 20_000,
        b"zz\n",
        b"\xff\n",
        line(b"", b""),
        line(b"A", bytes(31)),
        line(b"A", bytes(64)),
        line(b"A", IDENTITY),
        line(b"A", ORDER_2),
        line(b"A", b"\xff" * 32),
        line(b"B", IDENTITY),
        line(b"?", IDENTITY),
    ],
)
def test_other_traffic_uses_no_attempt(hub: Hub, member: Path, content: bytes) -> None:
    hub.serve()
    for _ in range(ATTEMPTS + 1):
        with hub.connect(content):
            pass
    hub.join(member)
    assert hub.admitted.result(10.0) == "127.0.0.1"
    assert not hub.complaints


def is_answered(connection: socket.socket) -> bool:
    """True if the hub sends something, and False once it has ended the connection."""
    with suppress(ConnectionResetError):
        return bool(connection.recv(100))
    return False


@pytest.mark.parametrize(
    ("count", "begins"),
    [(2 * MOST_HANDSHAKES, b""), (2 * MOST_HANDSHAKES, b"{"), (ATTEMPTS - 1, GUESS)],
    ids=["silent", "half a message", "tries a code"],
)
def test_machines_that_wait_are_few_and_delay_no_other(
    hub: Hub, member: Path, count: int, begins: bytes
) -> None:
    hub.serve()
    with ExitStack() as stack:
        waiting = [stack.enter_context(hub.connect(begins)) for _ in range(count)]
        for one in waiting[: count - MOST_HANDSHAKES] or waiting:
            assert is_answered(one) is (begins == GUESS), "the oldest of too many are ended"
        begun_s = time.monotonic()
        hub.join(member)
        assert hub.admitted.result(QUICK_S) == "127.0.0.1"
        assert time.monotonic() - begun_s < QUICK_S


@pytest.mark.parametrize("begins", [b"", GUESS], ids=["silent", "tries a code"])
def test_a_machine_that_waits_for_ever_is_left(
    hub: Hub, monkeypatch: pytest.MonkeyPatch, begins: bytes
) -> None:
    monkeypatch.setattr(pairing, "_ATTEMPT_S", 0.1)
    hub.serve()
    with hub.connect(begins) as connection:
        assert is_answered(connection) is (begins == GUESS)
        assert not is_answered(connection)


@pytest.mark.parametrize("knows_the_code", [False, True])
def test_a_message_that_is_sent_back_is_refused(member: Path, knows_the_code: bool) -> None:
    """By a hub that answers with what the member has sent: the fields of the two sides differ."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def mirror() -> None:
            connection, _ = listener.accept()
            with connection, connection.makefile("rwb") as file:
                share = file.readline()
                if knows_the_code:
                    share = line(SPAKE2_B(CODE.encode(), **SIDES).start(), b"")
                file.write(share)
                file.flush()
                file.write(file.readline())

        threading.Thread(target=mirror, daemon=True).start()
        with pytest.raises(ConfigurationError, match="not admitted"):
            asyncio.run(join(member, "127.0.0.1", CODE, listener.getsockname()[1]))
    assert read_machine(member) is None


def test_a_name_that_is_taken_is_refused_before_a_code_is_shown(hub: Hub, tmp_path: Path) -> None:
    admit(hub.folder, tmp_path / "gpu", "gpu", "10.0.0.2")
    for name in ("gpu", "robot"):
        with pytest.raises(ConfigurationError):
            PairingHub(hub.folder, name, CODE, lambda _: None)


def test_nobody_in_time_is_told_with_what_to_type(hub: Hub) -> None:
    with pytest.raises(ConfigurationError, match=r"within 0\.01 s") as caught:
        hub.serve(0.01).admitted.result(10.0)
    assert "roboneuron link add gpu" in caught.value.hint


def test_a_hub_that_is_not_there_and_a_taken_port_are_named(hub: Hub, member: Path) -> None:
    with pytest.raises(ConfigurationError, match=f"cannot listen on port {hub.port}"):
        open_listener(hub.port)
    hub.listener.close()
    with pytest.raises(ConfigurationError, match=rf"No hub answers at 127.0.0.1, port {hub.port}"):
        hub.join(member)


def test_codes_are_six_digits_and_differ() -> None:
    codes = {new_code() for _ in range(100)}
    assert all(len(code) == 6 and code.isdecimal() for code in codes)
    assert len(codes) > 90
