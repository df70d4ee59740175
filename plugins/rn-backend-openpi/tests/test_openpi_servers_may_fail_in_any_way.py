"""The remote backend with a stand-in for openpi's server that dies, stalls, sends wrong data and
returns.
"""

from __future__ import annotations

import logging
import shutil
import socket
import ssl
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from middle_man import MiddleMan
from openpi_clients import TIMEOUT_S

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from roboneuron.contract import Observation
from roboneuron.errors import (
    ConfigurationError,
    NotReadyError,
    StateError,
    UngroundedError,
    UnsafeError,
)

Observe = Callable[..., Observation]
SLACK_S = 6.0
"""Margin of a bounded wait for scheduling on a busy machine."""


@pytest.fixture
def backend(options: Callable[..., PolicyOptions]) -> Iterator[PolicyBackend]:
    """A loaded backend."""
    made = PolicyBackend(options())
    made.load()
    yield made
    made.close()


@contextmanager
def _freezing(url: str) -> Iterator[tuple[str, Callable[[], None]]]:
    """Address of a relay before a server, and a function after which it reads nothing."""
    frozen, ended = threading.Event(), threading.Event()

    def received(source: socket.socket) -> bytes:
        data = source.recv(4096)
        if frozen.is_set():
            ended.wait(30.0)
        if not data:
            raise ConnectionError("closed")
        return data

    scheme, port = url.split(":")[0], int(url.rsplit(":", 1)[1])
    with closing(MiddleMan(port, received, kept=1)) as man:
        yield f"{scheme}://{man.address}", frozen.set
        ended.set()


def _recovers(backend: PolicyBackend, observation: Observation) -> None:
    """Predict again, repeated while it is not ready."""
    deadline_s = time.monotonic() + 10.0
    while True:
        try:
            assert backend.predict(observation).actions.shape[1] == 7
            return
        except NotReadyError:
            assert time.monotonic() < deadline_s


def test_a_request_holds_what_openpis_libero_client_sends(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    backend.predict(observe(primary=200, size=(112, 224), instruction="close the drawer"))
    request = policy_server.requests[-1]
    assert set(request) == {"observation/image", "observation/state", "prompt"}
    image = request["observation/image"]
    assert (image.dtype, image.shape) == (np.uint8, (224, 224, 3))
    assert (image[0, 0, 0], image[112, 112, 0]) == (0, 200)  # black bars above and below
    np.testing.assert_allclose(
        request["observation/state"], [0.4, 0, 0.5, np.pi, 0, 0, 0.04, -0.04], atol=1e-12
    )
    assert request["prompt"] == "close the drawer"


def test_the_answer_becomes_contract_actions_with_the_servers_own_time(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    actions = np.array([[1.0, 0, 0, 0, 0, 0.5, -1.0]] * 3, dtype=np.float32)
    policy_server.answer = lambda request: {
        "actions": actions,
        "policy_timing": {"infer_ms": np.float64(12.5)},
    }
    chunk = backend.predict(observe())
    np.testing.assert_allclose(chunk.actions, [[0.05, 0, 0, 0, 0, 0.25, 1.0]] * 3, atol=1e-12)
    assert chunk.metrics["server_ms"] == 12.5
    assert chunk.metrics["inference_ms"] > 0
    assert (chunk.step_s, chunk.note) == (0.05, "")


def test_two_cameras_are_sent_and_a_missing_one_is_refused(
    policy_server: Any, options: Callable[..., PolicyOptions], observe: Observe
) -> None:
    keys = {"primary": "observation/image", "wrist": "observation/wrist_image"}
    backend = PolicyBackend(options(image_keys=keys, action_steps=2, image_flip="rotate-180"))
    backend.load()
    assert backend.predict(observe(wrist=7)).actions.shape == (2, 7)
    assert policy_server.requests[-1]["observation/wrist_image"].max() == 7
    with pytest.raises(UngroundedError, match="wrist"):
        backend.predict(observe())
    backend.close()


def test_an_answer_that_nobody_asked_for_is_not_taken_for_the_next(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    good = policy_server.answer
    backend.predict(observe())
    again = policy_server.answer({})
    policy_server.connection.send(policy_server._packed(again))
    deadline_s = time.monotonic() + SLACK_S
    while True:  # it is in transit for a moment, and answers none of these
        try:
            backend.predict(observe())
        except NotReadyError as error:
            assert "an answer without a request" in str(error)  # noqa: PT017
            break
        assert time.monotonic() < deadline_s
    policy_server.answer = good
    _recovers(backend, observe())


def test_a_server_that_dies_mid_request_is_reported_and_found_again(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    good = policy_server.answer
    policy_server.answer = lambda request: policy_server.stop()
    with pytest.raises(NotReadyError, match="is lost"):
        backend.predict(observe())
    with pytest.raises(NotReadyError, match="is being made"):
        backend.predict(observe())
    policy_server.answer = good
    policy_server.start()
    _recovers(backend, observe())
    assert backend.predict(observe()).metrics["connections"] == 2


def test_a_failed_request_is_not_sent_again(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    before = len(policy_server.requests)
    policy_server.answer = lambda request: policy_server.cut()
    with pytest.raises(NotReadyError):
        backend.predict(observe())
    assert len(policy_server.requests) == before + 1


def test_a_slow_answer_is_given_up_and_never_taken_for_the_next_one(
    policy_server: Any, backend: PolicyBackend, observe: Observe
) -> None:
    released = policy_server.released

    def slow(request: dict[Any, Any]) -> dict[str, Any]:
        released.wait(60 * TIMEOUT_S)
        return {"actions": np.full((1, 7), 0.5)}

    policy_server.answer = slow
    start = time.monotonic()
    with pytest.raises(NotReadyError, match="no answer within"):
        backend.predict(observe())
    assert time.monotonic() - start < TIMEOUT_S + SLACK_S
    policy_server.answer = lambda request: {"actions": np.zeros((1, 7))}
    released.set()
    _recovers(backend, observe())
    assert backend.predict(observe()).actions[0, 0] == 0.0


def test_a_half_open_connection_ends_in_time(
    options: Callable[..., PolicyOptions], observe: Observe
) -> None:
    # A peer that answers the handshake and the warm-up, then neither reads nor writes.
    with _freezing(options().url) as (url, freeze):
        backend = PolicyBackend(options(url=url, image_size_px=(1024, 1024)))
        backend.load()
        freeze()
        start = time.monotonic()
        with pytest.raises(NotReadyError, match="no answer within"):
            backend.predict(observe())
        backend.close()
        assert time.monotonic() - start < TIMEOUT_S + SLACK_S


@pytest.mark.skipif(shutil.which("openssl") is None, reason="makes a certificate with openssl")
def test_tls_is_verified_and_a_half_open_tls_connection_ends_in_time(
    policy_server: Any,
    options: Callable[..., PolicyOptions],
    observe: Observe,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 "
        "-subj /CN=localhost"
    )
    names = [
        "-addext",
        "subjectAltName=IP:127.0.0.1",
        "-keyout",
        str(key),
        "-out",
        str(certificate),
    ]
    subprocess.run([*command.split(), *names], check=True, capture_output=True, timeout=30)
    policy_server.stop()
    policy_server.tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    policy_server.tls.load_cert_chain(certificate, key)
    policy_server.start()
    with pytest.raises(ConfigurationError, match="not trusted"):
        PolicyBackend(options(url=policy_server.url)).load()
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    patient = PolicyBackend(options(url=policy_server.url, timeout_s=60.0))
    patient.load()
    assert patient.predict(observe()).note == ""
    patient.close()
    with _freezing(policy_server.url) as (url, freeze):
        backend = PolicyBackend(options(url=url, image_size_px=(1024, 1024)))
        backend.load()
        freeze()
        start = time.monotonic()
        with pytest.raises(NotReadyError, match="no answer within"):
            backend.predict(observe())
        backend.close()
        assert time.monotonic() - start < TIMEOUT_S + SLACK_S


def test_a_traceback_frame_is_shown_by_its_last_line(
    policy_server: Any,
    backend: PolicyBackend,
    observe: Observe,
    caplog: pytest.LogCaptureFixture,
) -> None:
    good = policy_server.answer

    def fail(request: dict[Any, Any]) -> dict[str, Any]:
        raise ValueError("state has 7 values, expected 8")

    policy_server.answer = fail
    with pytest.raises(NotReadyError, match="ValueError: state has 7 values, expected 8"):
        backend.predict(observe())
    assert "Traceback" in caplog.text
    policy_server.answer = good
    _recovers(backend, observe())


@pytest.mark.parametrize(
    ("reply", "word"),
    [
        ({"action": np.zeros((1, 7))}, "no array 'actions'"),
        ({"actions": [[0.0] * 7]}, "no array 'actions'"),
        ({"actions": np.zeros((5, 8))}, r"shape \(5, 8\)"),
        ({"actions": np.zeros(7)}, "shape"),
        ({"actions": np.zeros((0, 7))}, "shape"),
    ],
)
def test_a_malformed_answer_is_refused(
    policy_server: Any, backend: PolicyBackend, observe: Observe, reply: Any, word: str
) -> None:
    policy_server.answer = lambda request: reply
    with pytest.raises(ConfigurationError, match=word):
        backend.predict(observe())
    policy_server.answer = lambda request: {"actions": np.zeros((1, 7))}
    _recovers(backend, observe())


@pytest.mark.parametrize(
    ("reply", "word"),
    [
        (b"\xc1\xc1", "not in openpi's format"),
        (b"\x81", "not in openpi's format"),
        ([1, 2], "expected a map"),
        (
            {"actions": {b"__ndarray__": True, b"data": b"1234", b"dtype": "|O", b"shape": [1]}},
            "not a number type",
        ),
        (
            {
                "actions": {
                    b"__ndarray__": True,
                    b"data": b"1234",
                    b"dtype": "<f8",
                    b"shape": [9, 7],
                }
            },
            "4 bytes",
        ),
    ],
)
def test_garbage_ends_the_connection_which_is_made_anew(
    policy_server: Any, backend: PolicyBackend, observe: Observe, reply: Any, word: str
) -> None:
    policy_server.answer = lambda request: reply
    with pytest.raises(NotReadyError, match=word):
        backend.predict(observe())
    policy_server.answer = lambda request: {"actions": np.zeros((1, 7))}
    _recovers(backend, observe())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_actions_are_unsafe(
    policy_server: Any, backend: PolicyBackend, observe: Observe, bad: float
) -> None:
    policy_server.answer = lambda request: {"actions": np.full((2, 7), bad)}
    with pytest.raises(UnsafeError, match="non-finite"):
        backend.predict(observe())


def test_what_does_not_fit_is_found_by_load(
    policy_server: Any, options: Callable[..., PolicyOptions]
) -> None:
    policy_server.answer = lambda request: {"actions": np.zeros((10, 8))}
    with pytest.raises(ConfigurationError, match="8"):
        PolicyBackend(options()).load()
    policy_server.answer = lambda request: {"actions": np.full((10, 7), np.nan)}
    with pytest.raises(UnsafeError):
        PolicyBackend(options()).load()
    policy_server.answer = lambda request: {"actions": np.zeros((2, 7))}
    with pytest.raises(ConfigurationError, match="action_steps"):
        PolicyBackend(options(action_steps=3)).load()
    policy_server.metadata = "Traceback\nRuntimeError: no GPU"
    with pytest.raises(NotReadyError, match="no GPU"):
        PolicyBackend(options()).load()


def test_an_absent_server_is_reported_in_time(options: Callable[..., PolicyOptions]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        free = listener.getsockname()[1]
    start = time.monotonic()
    with pytest.raises(NotReadyError, match=r"cannot be reached within 0\.3 s"):
        PolicyBackend(options(url=f"ws://127.0.0.1:{free}", start_timeout_s=0.3)).load()
    assert time.monotonic() - start < 0.3 + SLACK_S


def test_something_else_that_listens_is_reported_in_time(
    options: Callable[..., PolicyOptions],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"ws://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(NotReadyError, match="cannot be reached"):
            PolicyBackend(options(url=url, start_timeout_s=0.3)).load()


def test_the_warning_is_logged_and_shown_in_every_chunk(
    options: Callable[..., PolicyOptions],
    observe: Observe,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rn_backend_openpi.security.is_loopback", lambda host: False)
    backend = PolicyBackend(options())
    with caplog.at_level(logging.WARNING):
        backend.load()
    assert "not encrypted" in caplog.text
    assert "not encrypted" in backend.predict(observe()).note
    backend.close()


def test_predict_is_refused_before_load_and_after_close(
    backend: PolicyBackend, observe: Observe
) -> None:
    backend.close()
    backend.close()
    for made in (backend, PolicyBackend(PolicyOptions(url="ws://gpu", profile="libero"))):
        with pytest.raises(StateError):
            made.predict(observe())
