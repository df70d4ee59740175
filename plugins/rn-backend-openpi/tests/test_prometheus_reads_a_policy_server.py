"""The metrics of `serve-policy` as read by Prometheus."""

from __future__ import annotations

import socket
import time
import urllib.request
from collections.abc import Iterator

import pytest
from openpi_clients import SLACK_S, ask, open_client
from policy_servers import RunningServer, robot_of
from prometheus_client.parser import text_string_to_metric_families
from websockets.exceptions import ConnectionClosed

from rn_backend_openpi.metrics import MetricsEndpoint
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.security import authorization
from rn_backend_openpi.statistics import BOUNDS_S, Times
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import ConfigurationError

pytestmark = pytest.mark.timeout(200)
SEEN = make_observation(SHARED)
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
    port = server.status()["metrics_port"]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20.0) as answer:
        said = answer.read().decode()
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(said)
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


@pytest.mark.exhaustive
def test_one_that_says_nothing_does_not_keep_others_waiting_for_long(
    server: RunningServer,
) -> None:
    port = server.status()["metrics_port"]
    with socket.create_connection(("127.0.0.1", port), 20.0):
        begun_s = time.monotonic()
        assert read(server)
        assert time.monotonic() - begun_s < 15.0


def test_times_are_counted_up_to_their_bound() -> None:
    times = Times()
    for took_s in (0.0, BOUNDS_S[0], BOUNDS_S[0] * 1.01, 99.0):
        times.note(took_s)
    counts = times.document()["counts"]
    assert (counts[0], counts[1], counts[-1], sum(counts)) == (2, 1, 1, 4)


def test_an_address_in_use_is_one_clear_error() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        pytest.raises(ConfigurationError, match="metrics_port"),
    ):
        MetricsEndpoint("127.0.0.1", taken.getsockname()[1], dict)
