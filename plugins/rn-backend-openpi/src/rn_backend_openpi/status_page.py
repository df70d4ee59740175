"""The statistics of a server, read at its local socket."""

from __future__ import annotations

import socket
from http import HTTPStatus
from http.client import HTTPException, HTTPResponse
from pathlib import Path

from rn_backend_openpi.messages import Document
from roboneuron import ForeignDataError, NotReadyError, foreign

STATUS = "/status"
"""Page with a server's statistics; on local sockets only."""
_LONGEST_S = 20.0


def page(path: Path, timeout_s: float) -> Document:
    """The status of the server at a local socket. Raises OSError or ForeignDataError."""
    with socket.socket(socket.AF_UNIX) as connected:
        connected.settimeout(timeout_s)
        connected.connect(str(path))
        connected.sendall(f"GET {STATUS} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        with HTTPResponse(connected) as answer:
            try:
                answer.begin()
                data = answer.read(foreign.MOST_BYTES)
            except HTTPException as error:
                raise ForeignDataError(f"a status is no answer of HTTP: {error!r}") from error
            if answer.status != HTTPStatus.OK:
                raise ForeignDataError(f"a status is refused: {answer.status}")
    return foreign.table(foreign.decode_json(data, "a status"), "a status")


def ask_status(path: Path) -> Document:
    """Status of the policy server at a local socket.

    Raises:
        NotReadyError: there is no server.
    """
    try:
        told = page(path, _LONGEST_S)
        foreign.field(told, "models")
    except (FileNotFoundError, ConnectionRefusedError) as error:
        raise NotReadyError(
            "No policy server of this file runs on this machine as this user.",
            hint="Start it with `roboneuron serve-policy`.",
        ) from error
    except (OSError, ForeignDataError) as error:
        raise NotReadyError(f"The policy server does not answer: {error}.") from error
    return told
