"""Clients of a policy server: the owner of a connection, and the share of clients that open
many.
"""

from __future__ import annotations

import socket
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from policy_servers import SEEN, RunningServer, Serve, link_of, pair

from rn_backend_shared.admission import AdmissionTable
from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.security import client_of
from rn_backend_shared.session import ModelSession, Welcome, greet
from rn_backend_shared.wire import from_observation
from rn_link.machine import read_machine
from rn_link.tls import tls_context
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError

pytestmark = pytest.mark.timeout(200)
MANY, ANSWERS, MOST_S = 12, 80, 60.0


@pytest.mark.parametrize(
    ("address", "client"),
    [
        ("192.168.1.10", "address 192.168.1.10"),
        ("::ffff:192.168.1.10", "address 192.168.1.10"),
        ("fd00:1:2:3:4:5:6:7", "address fd00:1:2:3::/64"),
        ("fe80::5%eth0", "address fe80::/64"),
        ("", "address "),
    ],
)
def test_a_client_in_clear_is_its_address(address: str, client: str) -> None:
    assert client_of(address) == client


def test_a_client_with_a_certificate_is_that(tmp_path: Path) -> None:
    found = []
    for number in (1, 2):
        states = tmp_path / f"robot{number}", tmp_path / f"gpu{number}"
        pair(*states)
        for _ in range(2):
            found.append(_shown(*map(link_of, states)))
    assert found[0].startswith("key ")
    assert (found[0], found[2]) == (found[1], found[3])
    assert found[0] != found[2]


def _shown(robot: Path, gpu: Path) -> str:
    here, there = socket.socketpair()
    machines = read_machine(robot), read_machine(gpu)
    assert machines[0] is not None
    assert machines[1] is not None
    near, far = tls_context(machines[0], robot, "gpu"), tls_context(machines[1], gpu, "robot")

    def connect() -> None:
        with near.wrap_socket(here) as connected, suppress(OSError):
            connected.recv(1)

    thread = threading.Thread(target=connect)
    thread.start()
    with far.wrap_socket(there, server_side=True) as connected:
        client = client_of("127.0.0.1", connected)
    thread.join(10.0)
    return client


class Guest:
    """A connection of a table."""

    def __init__(self, client: str) -> None:
        self.client = self.address = client
        self.is_interrupted = False

    def interrupt(self) -> None:
        self.is_interrupted = True


def test_a_table_that_is_full_takes_from_the_client_with_most() -> None:
    table = AdmissionTable(4)

    def enter(client: str) -> Guest:
        guest = Guest(client)
        table.add(guest)
        table.admit(guest)
        return guest

    greedy = [enter("greedy") for _ in range(4)]
    with pytest.raises(ConfigurationError, match="4 robots are connected"):
        enter("greedy")
    enter("one")
    assert [guest.is_interrupted for guest in greedy] == [False, False, False, True]
    enter("two")
    assert [guest.is_interrupted for guest in greedy] == [False, False, True, True]
    # one connection each, and two of the greedy client: nobody would be better off
    with pytest.raises(ConfigurationError, match="4 robots are connected"):
        enter("two")
    assert table.robots == 4


@pytest.fixture
def server(serve: Serve) -> RunningServer:
    """A server that takes 20 ms for each observation, one after the other."""
    return serve({"only": {"options": {"took_s": 0.02}, "most": 1}}, keys="token", robots=MANY)


def session_from(address: str, server: RunningServer, token: str) -> ModelSession:
    """A conversation with a server from one of the addresses of this machine."""
    connected = socket.create_connection(("127.0.0.1", server.port), 20.0, (address, 0))
    channel = FrameChannel(connected)
    welcome: Welcome = greet(channel, {"token": token}, 20.0)
    return ModelSession(channel, welcome)


def test_many_connections_get_no_more_answers_than_one(
    server: RunningServer, tmp_path: Path
) -> None:
    token = (tmp_path / "token").read_text().strip()
    seen = from_observation(SEEN)
    answered = {"127.0.0.1": 0, "127.0.0.2": 0}
    lock, all_ask = threading.Lock(), threading.Barrier(MANY, timeout=MOST_S)
    end_s = time.monotonic() + MOST_S

    def ask(address: str, session: ModelSession) -> None:
        session.ask(seen, end_s)
        all_ask.wait()
        while sum(answered.values()) < ANSWERS:
            session.ask(seen, end_s)
            with lock:
                answered[address] += 1

    with ExitStack() as stack:
        threads = []
        for address in ["127.0.0.2"] * (MANY - 1) + ["127.0.0.1"]:
            session = session_from(address, server, token)
            stack.callback(session.close)
            threads.append(threading.Thread(target=ask, args=(address, session)))
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(MOST_S)
    one, many = answered.values()
    assert one + many >= ANSWERS
    # equal except for the time between two of its requests; counted by connections it would be 11
    # times
    assert many < 3 * one, answered


def test_a_client_that_takes_all_places_keeps_nobody_out(
    server: RunningServer, tmp_path: Path
) -> None:
    token = (tmp_path / "token").read_text().strip()
    with ExitStack() as stack:
        many = [session_from("127.0.0.2", server, token) for _ in range(MANY)]
        for session in many:
            stack.callback(session.close)
        more = session_from("127.0.0.2", server, token)
        stack.callback(more.close)
        assert more.welcome.failure is not None
        one = session_from("127.0.0.1", server, token)
        stack.callback(one.close)
        seen = from_observation(SEEN)
        one.ask(seen, time.monotonic() + 20.0)
        with pytest.raises(OSError, match=r"closed|reset|Broken pipe"):
            many[-1].ask(seen, time.monotonic() + 20.0)
        many[0].ask(seen, time.monotonic() + 20.0)
        wait_until(lambda: server.status()["robots"] == MANY, 20.0)
