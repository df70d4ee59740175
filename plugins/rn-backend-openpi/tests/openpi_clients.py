"""Clients of the openpi server of tests."""

from __future__ import annotations

import http.client
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
from openpi_format import decode, encode
from websockets.sync.client import ClientConnection, connect

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.case import Reflex, ReflexOptions, serving
from rn_backend_openpi.options import PolicyOptions
from rn_testing.waiting import wait_until
from roboneuron import NotReadyError, Observation

KEY = "a-key-of-some-length"
TIMEOUT_S = 1.0
"""Time limit of a request to the stand-in for openpi's server."""
SLACK_S = 10.0
"""Margin of a bounded wait for scheduling on a busy machine."""
STATE = np.array([0.4, 0.0, 0.5, np.pi, 0.0, 0.0, 0.04, -0.04])
GREY = np.full((32, 48, 3), 90, dtype=np.uint8)
REQUEST = {"observation/image": GREY, "observation/state": STATE, "prompt": "go"}
KEYS = {"primary": "observation/image"}


INTERFACE = {"profile": "libero", "image_keys": KEYS}


def model() -> Reflex:
    return Reflex(ReflexOptions(step_s=0.05))


def open_client(url: str, **options: Any) -> ClientConnection:
    connection = connect(url, compression=None, max_size=None, proxy=None, **options)
    connection.metadata = msgpack.unpackb(connection.recv(timeout=SLACK_S))
    return connection


def ask(connection: ClientConnection, request: Any = REQUEST) -> Any:
    data = request if isinstance(request, bytes | str) else msgpack.packb(request, default=encode)
    connection.send(data)
    told = connection.recv(timeout=SLACK_S)
    return told if isinstance(told, str) else msgpack.unpackb(told, object_hook=decode)


@contextmanager
def served(**listen: Any) -> Iterator[str]:
    """A server of the small model in openpi's form of LIBERO; options of `[listen]`."""
    with serving(model(), interface=INTERFACE, **listen) as url:
        yield url


def http_get(url: str, path: str, **headers: str) -> tuple[int, bytes]:
    host, _, port = url.partition("://")[2].rpartition(":")
    asked = http.client.HTTPConnection(host.strip("[]"), int(port), timeout=SLACK_S)
    asked.request("GET", path, headers=headers)
    answer = asked.getresponse()
    return answer.status, answer.read()


@contextmanager
def loaded(options: PolicyOptions) -> Iterator[PolicyBackend]:
    """A loaded backend."""
    backend = PolicyBackend(options)
    backend.load()
    try:
        yield backend
    finally:
        backend.close()


def check_it_recovers(backend: PolicyBackend, observation: Observation) -> None:
    """Wait for the next answer."""

    def answers() -> bool:
        try:
            backend.predict(observation)
        except NotReadyError:
            return False
        return True

    wait_until(answers, SLACK_S, "it is answered again")


def make_certificate(folder: Path) -> tuple[Path, Path]:
    """Files of a certificate for 127.0.0.1 and ::1, and of its key."""
    pem, key = folder / "certificate.pem", folder / "key.pem"
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 "
        f"-subj /CN=localhost -addext subjectAltName=IP:127.0.0.1,IP:::1 -keyout {key} -out {pem}"
    )
    subprocess.run(command.split(), check=True, capture_output=True, timeout=30)
    return pem, key
