"""An HTTP server that has no policy at the address is named at once, not after the time limit."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from rn_backend_openpi.client import PolicyClient
from rn_backend_openpi.options import PolicyOptions
from roboneuron import ConfigurationError, NotReadyError, RoboNeuronError


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
def test_a_status_is_told_with_what_to_do(status: int, expected: type[RoboNeuronError]) -> None:
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
        with pytest.raises(NotReadyError) as failure:
            client.open()
    assert "no policy server" in str(failure.value)
