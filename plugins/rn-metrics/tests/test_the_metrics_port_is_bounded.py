"""Who may read the metrics, and how many connections the port has."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from http.client import HTTPConnection, RemoteDisconnected

import pytest
from prometheus_client import CollectorRegistry, Counter

from rn_metrics.exposition import Exposition
from rn_metrics.feature import host_rules
from rn_standard.http.options import HttpOptions
from rn_standard.http.tokens import TokenTable
from rn_testing.waiting import is_closed
from roboneuron import ConfigurationError
from roboneuron.server.tool import Holder

pytestmark = pytest.mark.timeout(60)
TOKEN = "0123456789abcdef"
TOKENS = TokenTable([(TOKEN, Holder(who="prometheus", role="viewer"))])
LAN = HttpOptions(allowed_hosts=("robot.lan",))


@pytest.fixture
def port() -> Iterator[int]:
    with_one = CollectorRegistry()
    Counter("seen", "Seen.", registry=with_one)
    made = Exposition.join(
        "127.0.0.1", 0, "left", with_one, host_rules("127.0.0.1", HttpOptions()), TOKENS
    )
    yield made.port
    made.leave("left")


@pytest.fixture
def lan_port() -> Iterator[int]:
    made = Exposition.join(
        "0.0.0.0", 0, "left", CollectorRegistry(), host_rules("0.0.0.0", LAN), TOKENS
    )
    yield made.port
    made.leave("left")


def ask(port: int, path: str = "/metrics", method: str = "GET", **headers: str) -> tuple[int, str]:
    with closing(HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        assert answer.getheader("Connection") == "close"
        return answer.status, answer.read().decode()


def ask_again(port: int) -> int:
    """Status of an answer; on a busy machine those of a crowd that are taken later push a first
    question out.
    """
    for _ in range(10):
        try:
            return ask(port)[0]
        except (ConnectionError, RemoteDisconnected):
            continue
    raise AssertionError("nobody is answered while a crowd holds the port")


def test_only_one_path_and_this_machines_names_are_answered(port: int) -> None:
    status, text = ask(port)
    assert status == 200
    assert 'seen_total{robot="left"}' in text
    assert ask(port, "/")[0] == 404
    assert ask(port, "/metrics/x")[0] == 404
    assert ask(port, method="POST")[0] == 405
    assert ask(port, Host="evil.example")[0] == 421
    assert ask(port, Host="localhost:1")[0] == 200


def test_beyond_loopback_a_token_is_needed(lan_port: int) -> None:
    assert ask(lan_port, Host="robot.lan")[0] == 401
    assert ask(lan_port, Host="robot.lan", Authorization="Bearer 0123456789abcdeX")[0] == 401
    assert ask(lan_port, Host="robot.lan", Authorization=f"Bearer {TOKEN}")[0] == 200
    assert ask(lan_port, Host="evil.example", Authorization=f"Bearer {TOKEN}")[0] == 421


def test_without_a_token_there_is_no_port_beyond_loopback() -> None:
    with pytest.raises(ConfigurationError, match="there is no token"):
        Exposition.join(
            "0.0.0.0", 0, "left", CollectorRegistry(), host_rules("0.0.0.0", LAN), TokenTable([])
        )


def test_idle_connections_take_no_thread_and_keep_nobody_out(port: int) -> None:
    with ExitStack() as stack:
        before = threading.active_count()
        for _ in range(200):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20))
        assert ask(port)[0] == 200
        assert threading.active_count() == before


@pytest.mark.exhaustive
def test_slow_requests_give_way(port: int) -> None:
    with ExitStack() as stack:
        crowd = [
            stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=20))
            for _ in range(60)
        ]
        for one in crowd:
            one.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert ask_again(port) == 200
        assert is_closed(crowd[0])
