"""The backend with a stand-in for openpi's server, and with servers that are none: what dies,
stalls or sends wrong data is one error in time, and whoever returns is found again.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_engines import ScriptedServer
from middle_man import MiddleMan
from openpi_clients import TIMEOUT_S, check_it_recovers, loaded, make_certificate

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.client import PolicyClient
from rn_backend_openpi.options import PolicyOptions
from roboneuron import (
    ConfigurationError,
    NotReadyError,
    Observation,
    RoboNeuronError,
    StateError,
    UnsafeError,
)

Observe = Callable[..., Observation]
Options = Callable[..., PolicyOptions]
SLACK_S = 6.0
"""Margin of a bounded wait for scheduling on a busy machine."""
ZEROS = {"actions": np.zeros((10, 7))}


@pytest.fixture
def backend(options: Options) -> Iterator[PolicyBackend]:
    """A loaded backend."""
    with loaded(options()) as made:
        yield made


def array(data: bytes, dtype: str, shape: list[int]) -> dict[str, Any]:
    fields = {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}
    return {"actions": fields}


@pytest.mark.parametrize(
    ("reply", "error", "word"),
    [
        ({"action": np.zeros((1, 7))}, ConfigurationError, "no array 'actions'"),
        ({"actions": [[0.0] * 7]}, ConfigurationError, "no array 'actions'"),
        ({"actions": np.zeros((5, 8))}, ConfigurationError, r"shape \(5, 8\)"),
        ({"actions": np.zeros(7)}, ConfigurationError, "shape"),
        ({"actions": np.zeros((0, 7))}, ConfigurationError, "shape"),
        ({"actions": np.full((2, 7), np.nan)}, UnsafeError, "non-finite"),
        # clipping would hide infinities
        ({"actions": np.array([[-np.inf] + [0.0] * 6])}, UnsafeError, "non-finite"),
        (b"\xc1\xc1", NotReadyError, "not in openpi's format"),
        (b"\x81", NotReadyError, "not in openpi's format"),
        ([1, 2], NotReadyError, "expected a map"),
        (array(b"1234", "|O", [1]), NotReadyError, "not a number type"),
        (array(b"1234", "<f8", [9, 7]), NotReadyError, "4 bytes"),
        ({"type": "error", "message": "it broke"}, NotReadyError, "it broke"),
        (ValueError("state has 7 values"), NotReadyError, "ValueError: state has 7 values"),
    ],
)
def test_a_wrong_answer_is_one_error_and_the_next_one_is_taken(
    policy_server: ScriptedServer,
    backend: PolicyBackend,
    observe: Observe,
    reply: Any,
    error: type[RoboNeuronError],
    word: str,
) -> None:
    def answer(request: dict[Any, Any]) -> Any:
        if isinstance(reply, Exception):
            raise reply
        return reply

    policy_server.reply = answer
    with pytest.raises(error, match=word):
        backend.predict(observe())
    policy_server.reply = lambda request: ZEROS
    check_it_recovers(backend, observe())


@pytest.mark.parametrize(
    ("told", "reply", "options_", "error", "word"),
    [
        ({}, {"actions": np.zeros((10, 8))}, {}, ConfigurationError, "8"),
        ({}, {"actions": np.full((10, 7), np.nan)}, {}, UnsafeError, "non-finite"),
        ({}, ZEROS, {"action_steps": 11}, ConfigurationError, "action_steps"),
        ("Traceback\nRuntimeError: no GPU", ZEROS, {}, NotReadyError, "no GPU"),
        ('{"type":"error","error":"no policy"}', ZEROS, {}, NotReadyError, "no policy"),
    ],
)
def test_what_does_not_fit_is_found_by_load(
    policy_server: ScriptedServer,
    options: Options,
    told: Any,
    reply: Any,
    options_: dict[str, Any],
    error: type[RoboNeuronError],
    word: str,
) -> None:
    policy_server.told, policy_server.reply = told, lambda request: reply
    with pytest.raises(error, match=word):
        PolicyBackend(options(**options_)).load()


def test_a_server_that_dies_is_reported_asked_no_second_time_and_found_again(
    policy_server: ScriptedServer, backend: PolicyBackend, observe: Observe
) -> None:
    before = len(policy_server.requests)
    policy_server.reply = lambda request: policy_server.stop()
    with pytest.raises(NotReadyError, match="is lost"):
        backend.predict(observe())
    assert len(policy_server.requests) == before + 1
    with pytest.raises(NotReadyError, match="is being made"):
        backend.predict(observe())
    policy_server.reply = lambda request: ZEROS
    policy_server.start()
    check_it_recovers(backend, observe())
    chunk = backend.predict(observe())
    assert (chunk.metrics["connections"], chunk.note) == (2, "")


def test_an_answer_that_nobody_asked_for_is_not_taken_for_the_next(
    policy_server: ScriptedServer, backend: PolicyBackend, observe: Observe
) -> None:
    policy_server.connections[-1].send(policy_server.packed(ZEROS))
    deadline_s = time.monotonic() + SLACK_S
    while True:  # it is in transit for a moment, and answers none of these
        try:
            backend.predict(observe())
        except NotReadyError as error:
            assert "an answer without a request" in str(error)  # noqa: PT017
            break
        assert time.monotonic() < deadline_s
    check_it_recovers(backend, observe())


def test_a_connection_that_an_idle_server_closed_costs_no_prediction(
    policy_server: ScriptedServer, backend: PolicyBackend, observe: Observe
) -> None:
    connection = policy_server.connections[-1]
    connection.close(code=1001, reason="idle")
    connection.recv_events_thread.join(5.0)
    assert backend.predict(observe()).metrics["connections"] == 2


@contextmanager
def freezing(url: str) -> Iterator[tuple[str, Callable[[], None]]]:
    """Address of a relay before a server, and a function after which it reads nothing."""
    frozen, ended = threading.Event(), threading.Event()

    def received(source: socket.socket) -> bytes:
        data = source.recv(4096)
        if frozen.is_set():
            ended.wait(30.0)
        if not data:
            raise ConnectionError("closed")
        return data

    scheme, _, port = url.split(":")
    with closing(MiddleMan(int(port), received, kept=1)) as man:
        yield f"{scheme}://{man.address}", frozen.set
        ended.set()


@pytest.mark.parametrize("has_tls", [False, True])
def test_a_half_open_connection_ends_in_time(
    policy_server: ScriptedServer,
    options: Options,
    observe: Observe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    has_tls: bool,
) -> None:
    """A peer answers the handshake and the warm-up, then neither reads nor writes."""
    if has_tls:
        certificate, key = make_certificate(tmp_path)
        policy_server.stop()
        policy_server.tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        policy_server.tls.load_cert_chain(certificate, key)
        policy_server.start()
        with pytest.raises(ConfigurationError, match="not trusted"):
            PolicyBackend(options(url=policy_server.url)).load()
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    with freezing(policy_server.url) as (url, freeze):
        with loaded(options(url=url, image_size_px=(1024, 1024))) as backend:
            freeze()
            start = time.monotonic()
            with pytest.raises(NotReadyError, match="no answer within"):
                backend.predict(observe())
        assert time.monotonic() - start < TIMEOUT_S + SLACK_S


@pytest.mark.parametrize("kind", ["absent", "silent", "without metadata"])
def test_a_server_that_is_none_is_reported_in_time(
    policy_server: ScriptedServer, options: Options, kind: str
) -> None:
    url, word = policy_server.url, r"cannot be reached within 0\.4 s"
    with socket.create_server(("127.0.0.1", 0)) as listener:
        if kind != "without metadata":
            url = f"ws://127.0.0.1:{listener.getsockname()[1]}"
        if kind == "absent":
            listener.close()
        if kind == "without metadata":
            released, word = threading.Event(), "accepted the connection, but sends no first"
            policy_server.wait = lambda: released.wait(30.0)
        start = time.monotonic()
        with pytest.raises(NotReadyError, match=word):
            PolicyBackend(options(url=url, start_timeout_s=0.4)).load()
        assert time.monotonic() - start < 0.4 + SLACK_S
    if kind == "without metadata":
        released.set()


def test_metadata_that_come_late_are_waited_for(
    policy_server: ScriptedServer, options: Options, observe: Observe
) -> None:
    late = threading.Event()
    policy_server.wait = lambda: late.wait(0.5)
    with loaded(options()) as backend:
        assert backend.predict(observe()).metrics["connections"] == 1


@contextmanager
def answering(status: int, protocol: str = "HTTP/1.1") -> Iterator[str]:
    """Address of an HTTP server that answers everything with this status."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = protocol

        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        yield f"ws://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        *((status, ConfigurationError) for status in (200, 400, 401, 403, 404, 405, 410, 426, 501)),
        *((status, NotReadyError) for status in (429, 500, 502, 503, 504)),
    ],
)
def test_a_status_of_http_is_told_with_what_to_do(
    status: int, expected: type[RoboNeuronError]
) -> None:
    begun_s = time.monotonic()
    limit_s = 1.0 if expected is NotReadyError else 20.0
    with answering(status) as url:
        client = PolicyClient(PolicyOptions(url=url, start_timeout_s=limit_s))
        with pytest.raises(expected) as failure:
            client.open()
    assert time.monotonic() - begun_s < 15.0
    assert str(status) in str(failure.value)
    assert failure.value.hint


def test_an_answer_that_is_no_websocket_is_not_called_silence() -> None:
    with answering(404, "HTTP/1.0") as url:
        client = PolicyClient(PolicyOptions(url=url, start_timeout_s=0.5))
        with pytest.raises(NotReadyError, match="no policy server"):
            client.open()


def test_the_warning_is_logged_and_shown_in_every_chunk(
    options: Options,
    observe: Observe,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rn_backend_openpi.security.is_loopback", lambda host: False)
    with caplog.at_level(logging.WARNING), loaded(options()) as backend:
        assert "not encrypted" in backend.predict(observe()).note
    assert "not encrypted" in caplog.text


def test_predict_is_refused_before_load_and_after_close(
    backend: PolicyBackend, observe: Observe
) -> None:
    backend.close()
    backend.close()
    for made in (backend, PolicyBackend(PolicyOptions(url="ws://gpu", profile="libero"))):
        with pytest.raises(StateError):
            made.predict(observe())
