"""A machine is admitted only with the six digits that the hub shows."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path

import pytest
from link_pairs import admit, make_hub
from spake2 import SPAKE2_A, SPAKE2_B

from rn_link.machine import Peer, read_machine
from rn_link.pairing import ATTEMPTS, PairingHub, join, new_code, open_listener
from roboneuron import ConfigurationError

CODE, OTHER = "123456", "123457"
PORT = 7500
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
        self.admitted: Future[Peer] = Future()
        self.complaints: list[str] = []

    def serve(self, limit_s: float = 30.0) -> Hub:
        """Begin."""
        hub = PairingHub(self.folder, "gpu", CODE, self.complaints.append)

        def run() -> None:
            try:
                self.admitted.set_result(asyncio.run(hub.serve(self.listener, limit_s)))
            except (ConfigurationError, OSError) as error:
                self.admitted.set_exception(error)

        threading.Thread(target=run, daemon=True).start()
        return self

    def connect(self, content: bytes = b"") -> socket.socket:
        """A connection that has sent this."""
        made = socket.create_connection(("127.0.0.1", self.port), 5.0)
        made.sendall(content)
        return made

    def join(self, folder: Path, code: str = CODE) -> None:
        """Pair a member."""
        asyncio.run(join(folder, "127.0.0.1", self.port, code, PORT))


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    make_hub(tmp_path / "hub")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield Hub(tmp_path / "hub", listener)


@pytest.fixture
def member(tmp_path: Path) -> Path:
    return tmp_path / "member"


def share_of(code: str) -> bytes:
    """A message with which an attempt begins."""
    share: bytes = SPAKE2_A(code.encode(), **SIDES).start()
    return json.dumps({"share": share.hex()}).encode() + b"\n"


def test_a_machine_with_the_code_is_admitted(hub: Hub, member: Path) -> None:
    hub.serve().join(member)
    assert hub.admitted.result(10.0) == Peer("127.0.0.1", PORT)
    found, own = read_machine(member), read_machine(hub.folder)
    assert found is not None
    assert own is not None
    assert (found.name, found.role, list(found.peers)) == ("gpu", "member", ["robot"])
    assert own.peers == {"gpu": Peer("127.0.0.1", PORT)}
    for one, other, name in ((hub.folder, member, "robot"), (member, hub.folder, "gpu")):
        assert (one / "own.pem").read_bytes() == (other / "peers" / f"{name}.pem").read_bytes()


def test_a_wrong_code_changes_nothing_and_the_right_one_still_works(hub: Hub, member: Path) -> None:
    hub.serve()
    with pytest.raises(ConfigurationError, match="not admitted"):
        hub.join(member, OTHER)
    assert read_machine(member) is None
    hub.join(member)
    assert hub.admitted.result(10.0).address == "127.0.0.1"
    assert hub.complaints == ["127.0.0.1: the code is not that of the other machine."]


@pytest.mark.parametrize("kind", ["wrong", "leaves"])
def test_a_code_is_void_after_three_attempts(hub: Hub, member: Path, kind: str) -> None:
    """Who leaves after the hub's share may have tried a code."""
    hub.serve()
    for _ in range(ATTEMPTS):
        if kind == "wrong":
            with pytest.raises(ConfigurationError, match="not admitted"):
                hub.join(member, OTHER)
        else:
            with hub.connect(share_of(OTHER)) as connection:
                connection.recv(1)
    with pytest.raises(ConfigurationError, match="3 attempts had a wrong code"):
        hub.admitted.result(10.0)
    found = read_machine(hub.folder)
    assert found is not None
    assert not found.peers


def hub_share(side: bytes, point: bytes) -> bytes:
    return json.dumps({"share": (side + point).hex()}).encode() + b"\n"


IDENTITY = (1).to_bytes(32, "little")
ORDER_2 = (2**255 - 20).to_bytes(32, "little")
"""Points of small order, which would determine the key."""


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"GET / HTTP/1.1\r\n\r\n",
        b"[]\n",
        b"{}\n",
        b"x" * 20_000,
        b'{"share": "zz"}\n',
        hub_share(b"", b""),
        hub_share(b"A", bytes(31)),
        hub_share(b"A", bytes(64)),
        hub_share(b"A", IDENTITY),
        hub_share(b"A", ORDER_2),
        hub_share(b"A", b"\xff" * 32),
        hub_share(b"B", IDENTITY),
        hub_share(b"?", IDENTITY),
    ],
)
def test_other_traffic_uses_no_attempt(hub: Hub, member: Path, content: bytes) -> None:
    hub.serve()
    for _ in range(ATTEMPTS + 1):
        with hub.connect(content):
            pass
    hub.join(member)
    assert hub.admitted.result(10.0).port == PORT
    assert len(hub.complaints) == ATTEMPTS + 1


@pytest.mark.parametrize(
    ("count", "begins"),
    [(100, b""), (100, b"{"), (ATTEMPTS - 1, share_of(OTHER))],
    ids=["silent", "half a message", "tries a code"],
)
def test_machines_that_wait_delay_no_other(
    hub: Hub, member: Path, count: int, begins: bytes
) -> None:
    hub.serve()
    with ExitStack() as waiting:
        for _ in range(count):
            one = waiting.enter_context(hub.connect(begins))
            if begins.endswith(b"\n"):
                one.recv(1)
        begun_s = time.monotonic()
        hub.join(member)
        assert hub.admitted.result(QUICK_S).port == PORT
        assert time.monotonic() - begun_s < QUICK_S


def test_a_message_that_is_sent_back_is_refused(member: Path) -> None:
    """A hub that does not know the code, and answers with what the member has sent."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def mirror() -> None:
            connection, _ = listener.accept()
            with connection, connection.makefile("rwb") as file:
                for _ in range(2):
                    file.write(file.readline())
                    file.flush()

        threading.Thread(target=mirror, daemon=True).start()
        with pytest.raises(ConfigurationError, match="no valid share"):
            asyncio.run(join(member, "127.0.0.1", listener.getsockname()[1], CODE, PORT))
    assert read_machine(member) is None


def test_a_sealed_message_that_is_sent_back_is_refused(member: Path) -> None:
    """By a hub that knows the code: the fields of the two sides differ."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def mirror() -> None:
            connection, _ = listener.accept()
            with connection, connection.makefile("rwb") as file:
                file.readline()
                share = SPAKE2_B(CODE.encode(), **SIDES).start()
                file.write(json.dumps({"share": share.hex()}).encode() + b"\n")
                file.flush()
                file.write(file.readline())

        threading.Thread(target=mirror, daemon=True).start()
        with pytest.raises(ConfigurationError, match="not admitted"):
            asyncio.run(join(member, "127.0.0.1", listener.getsockname()[1], CODE, PORT))
    assert read_machine(member) is None


def test_a_name_that_is_taken_is_refused_before_a_code_is_shown(hub: Hub, tmp_path: Path) -> None:
    admit(hub.folder, tmp_path / "gpu", "gpu", Peer("10.0.0.2"))
    for name in ("gpu", "robot"):
        with pytest.raises(ConfigurationError):
            PairingHub(hub.folder, name, CODE, lambda _: None)


def test_nobody_in_time_is_told_with_what_to_type(hub: Hub) -> None:
    with pytest.raises(ConfigurationError, match=r"within 0\.01 s") as caught:
        hub.serve(0.01).admitted.result(10.0)
    assert "roboneuron link add gpu" in str(caught.value)


def test_a_hub_that_is_not_there_is_named(hub: Hub, member: Path) -> None:
    hub.listener.close()
    with pytest.raises(ConfigurationError, match=rf"No hub answers at 127.0.0.1, port {hub.port}"):
        hub.join(member)


def test_a_taken_port_is_told() -> None:
    taken = socket.create_server(("0.0.0.0", 0))
    with taken, pytest.raises(ConfigurationError, match="cannot listen on port"):
        open_listener(taken.getsockname()[1])


def test_codes_are_six_digits_and_differ() -> None:
    codes = {new_code() for _ in range(100)}
    assert all(len(code) == 6 and code.isdecimal() for code in codes)
    assert len(codes) > 90
