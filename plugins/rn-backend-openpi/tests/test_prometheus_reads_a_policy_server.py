"""The metrics of `policy serve` as read by Prometheus."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from openpi_clients import SLACK_S, ask, http_get, open_client
from policy_servers import RunningServer, robot_of
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed

from rn_backend_openpi.front import PolicyServer
from rn_backend_openpi.listener import HANDSHAKE_S
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.security import authorization
from rn_backend_openpi.server_options import PolicyServerOptions
from rn_backend_openpi.statistics import BOUNDS_S, Times
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError

pytestmark = pytest.mark.timeout(200)
SEEN = make_observation(SHARED)
MODELS = {"only": {"backend": "reflex"}}
Numbers = dict[tuple[str, frozenset[tuple[str, str]]], float]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    folder = tmp_path_factory.mktemp("served")
    listen = {"keys": "token", "token_file": str(folder / "token"), "metrics_port": 0}
    made = RunningServer(folder, {"one": {}, "other": {}}, listen)
    try:
        yield made.start()
    finally:
        made.end()


def read(server: RunningServer) -> Numbers:
    _, said = http_get(f"ws://127.0.0.1:{server.status()['metrics_port']}", "/metrics")
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(said.decode())
        for sample in family.samples
    }


def found(numbers: Numbers, name: str, **labels: str) -> float:
    return numbers[f"roboneuron_policy_{name}", frozenset(labels.items())]


def test_requests_times_and_robots_are_told_by_model(server: RunningServer) -> None:
    token = str(server.folder / "token")
    robot = robot_of(server.address, token_file=token, model="one", coding="raw")
    robot.load()
    for _ in range(5):
        robot.predict(SEEN)
    numbers = read(server)
    assert found(numbers, "ready", model="one") == 1.0
    assert found(numbers, "requests_total", model="one", outcome="answered") == 5.0
    assert found(numbers, "requests_total", model="other", outcome="answered") == 0.0
    assert found(numbers, "batches_total", model="one") == 5.0
    assert found(numbers, "clients", model="one") == 1.0
    assert found(numbers, "robots") == 1.0
    for name in ("model_seconds", "queue_seconds"):
        assert found(numbers, f"{name}_count", model="one") == 5.0
        assert found(numbers, f"{name}_bucket", model="one", le="+Inf") == 5.0
    assert found(numbers, "served_seconds_count", model="one") == 5.0
    whole = found(numbers, "served_seconds_sum", model="one")
    assert whole > found(numbers, "model_seconds_sum", model="one") > 0.0
    assert found(numbers, "lost_total", model="one") == 0.0
    robot.close()


def test_a_refused_request_is_no_lost_observation(server: RunningServer) -> None:
    wait_until(lambda: timed(server) == {"one", "other"}, 60.0)
    token = (server.folder / "token").read_text().strip()
    headers = {"Authorization": authorization(token)}
    with open_client(f"ws://{server.address}/other", additional_headers=headers) as client:
        assert str(ask(client, b"\xc1")).startswith("ForeignDataError")
        with pytest.raises(ConnectionClosed):
            client.recv(timeout=SLACK_S)
    wait_until(lambda: found(read(server), "robots") == 0.0, 20.0)
    assert found(read(server), "lost_total", model="other") == 0.0


def timed(server: RunningServer) -> set[str]:
    """Models with time metrics, which they have after loading."""
    told = [dict(labels) for name, labels in read(server) if name.endswith("model_seconds_sum")]
    return {labels["model"] for labels in told}


def test_who_connects_adds_no_labels(server: RunningServer) -> None:
    wait_until(lambda: timed(server) == {"one", "other"}, 60.0)
    before, refused = read(server), "refused_connections_total"
    port = server.port
    for word in (b"x" * 64, b'[{"model": "made-up"}, []]', b"GET / HTTP/1.1\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", port), 20.0) as stranger:
            stranger.sendall(word)
    wait_until(lambda: found(read(server), refused) == found(before, refused) + 3.0, 30.0)
    with pytest.raises(ConfigurationError, match="no model"):
        robot_of(server.address, token_file=str(server.folder / "token"), model="made-up").load()
    assert read(server).keys() == before.keys()


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no address of IPv6")
@pytest.mark.parametrize(
    ("host", "reached"),
    [
        ("127.0.0.1", ["127.0.0.1"]),
        ("::1", ["[::1]"]),
        ("localhost", ["127.0.0.1"]),
        ("gpu.lab", ["127.0.0.1", "[::1]"]),
        ("0.0.0.0", ["127.0.0.1"]),
        ("::", ["127.0.0.1", "[::1]"]),
    ],
)
def test_both_addresses_may_be_of_either_family_or_a_name(
    front: Callable[..., PolicyServer],
    monkeypatch: pytest.MonkeyPatch,
    host: str,
    reached: list[str],
) -> None:
    resolve = socket.getaddrinfo

    def resolved(name: str, *rest: Any, **named: Any) -> Any:
        if name != "gpu.lab":
            return resolve(name, *rest, **named)
        # of a name with an address that this machine has not
        addresses = ("192.0.2.1", "::1", "127.0.0.1")
        return [found for one in addresses for found in resolve(one, *rest, **named)]

    monkeypatch.setattr(socket, "getaddrinfo", resolved)
    server = front(host=host, insecure=True, metrics_host=host, metrics_port=0)
    for one in reached:
        assert http_get(f"ws://{one}:{server.port}", "/healthz")[0] == 503
        assert http_get(f"ws://{one}:{server.metrics_port}", "/metrics?x=1")[0] == 200
    robots, _, port = server.status()["address"].rpartition(":")
    assert (robots.strip("[]"), int(port)) == (host, server.port)


def test_silent_clients_keep_no_scrape_waiting(front: Callable[..., PolicyServer]) -> None:
    url = f"ws://127.0.0.1:{front(metrics_port=0).metrics_port}"
    with ExitStack() as opened:
        for _ in range(20):
            place = ("127.0.0.1", int(url.rpartition(":")[2]))
            silent = opened.enter_context(socket.create_connection(place, 20.0))
            silent.send(b"GET /me")
        begun_s = time.monotonic()
        status, text = http_get(url, "/metrics")
        assert time.monotonic() - begun_s < HANDSHAKE_S, "none of them was waited for"
    assert status == 200
    assert b"roboneuron_policy_robots 0.0" in text
    assert http_get(url, "/status")[0] == 404


@pytest.mark.parametrize(("host", "port"), [("host", "port"), ("metrics_host", "metrics_port")])
def test_an_address_that_cannot_be_used_is_one_clear_error(
    tmp_path: Path, host: str, port: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for where, number in (("127.0.0.1", taken.getsockname()[1]), ("no.such.host.invalid", 0)):
            listen = {"port": 0, "keys": "none", "insecure": True, host: where, port: number}
            tables = {"listen": listen, "models": MODELS}
            server = PolicyServer(PolicyServerOptions.model_validate(tables), tmp_path, "front")
            with pytest.raises(ConfigurationError, match="cannot listen on") as caught:
                server.run()
            assert f"{port} in [listen]" in caught.value.hint


def test_times_are_counted_up_to_their_bound() -> None:
    times = Times()
    for took_s in (0.0, BOUNDS_S[0], BOUNDS_S[0] * 1.01, 99.0):
        times.note(took_s)
    counts = times.document()["counts"]
    assert (counts[0], counts[1], counts[-1], sum(counts)) == (2, 1, 1, 4)
