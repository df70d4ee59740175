"""A persistent HTTP connection with a deadline for each whole request, which another thread can
cut.
"""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import httpx2

from roboneuron import NotReadyError

MAX_ANSWER_BYTES = 4 << 20
"""Limit of an answer; no valid one is longer."""
_LOCAL = ("127.0.0.1", "::1", "localhost")
_JSON = {"Content-Type": "application/json"}
_CONNECTED = ("connection.connect_tcp.complete", "connection.start_tls.complete")


class ServerLost(NotReadyError):
    """A server cannot be reached or closed the connection; another one may answer."""


class AnswerTooLate(NotReadyError):
    """The deadline passed before the answer was complete."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Access:
    """Address and credentials of a server.

    Attributes:
        url: "http://host:port" or "https://host:port".
        key: API key, empty for none.
        connect_timeout_s: bound on opening a connection [s].
        tls: TLS context that checks certificates; needed for https.
    """

    url: str
    key: str
    connect_timeout_s: float
    tls: ssl.SSLContext | None = None

    @property
    def is_open_to_others(self) -> bool:
        """True if requests and key are sent unencrypted over a network."""
        parts = urlsplit(self.url)
        return parts.scheme == "http" and parts.hostname not in _LOCAL


@dataclass(frozen=True, kw_only=True, slots=True)
class HttpAnswer:
    """Status and body of an answer."""

    status: int
    body: bytes


class HttpConnection:
    """Used by one thread at a time; `cut` may be called from any."""

    def __init__(self, access: Access) -> None:
        self._access = access
        # no Client, because that logs a line for each request
        self._transport = httpx2.HTTPTransport(
            # without `tls` no certificate is trusted: reading the default ones takes 0.1 s
            verify=access.tls or ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT),
            trust_env=False,
            limits=httpx2.Limits(max_connections=1, keepalive_expiry=None),
        )
        self._headers = {"Authorization": f"Bearer {access.key}"} if access.key else {}
        self._socket: socket.socket | None = None

    def request(
        self, method: str, path: str, deadline_s: float, body: bytes | None = None
    ) -> HttpAnswer:
        """Send one request and read its answer.

        Args:
            method, path: "GET" or "POST", and the path.
            deadline_s: `time.monotonic()` by which the whole answer must be complete.
            body: JSON, if any.

        Raises:
            ServerLost: no connection, or it broke.
            AnswerTooLate: the deadline passed.
        """
        url = self._access.url
        left_s = deadline_s - time.monotonic()
        late = AnswerTooLate(f"{url} did not answer {path} in time.")
        if left_s <= 0:
            raise late
        connect_s = min(self._access.connect_timeout_s, left_s)
        # the timeouts bound each step, but an answer may arrive slowly
        end = threading.Timer(left_s, self.cut)
        end.daemon = True
        end.start()
        try:
            return self._exchange(method, path, body, httpx2.Timeout(left_s, connect=connect_s))
        except httpx2.ConnectTimeout as error:
            raise ServerLost(
                f"{url} cannot be reached (no connection within {connect_s:.2f} s)."
            ) from error
        except httpx2.TransportError as error:
            if isinstance(error, httpx2.TimeoutException) or time.monotonic() >= deadline_s:
                raise late from error
            text = str(error) or type(error).__name__
            raise ServerLost(f"{url} cannot be reached or hung up ({text}).") from error
        finally:
            end.cancel()
            end.join()  # otherwise it could cut the next request

    def _exchange(
        self, method: str, path: str, body: bytes | None, timeout: httpx2.Timeout
    ) -> HttpAnswer:
        request = httpx2.Request(
            method,
            f"{self._access.url}{path}",
            content=body,
            headers=self._headers if body is None else {**self._headers, **_JSON},
            extensions={"timeout": timeout.as_dict(), "trace": self._note_socket},
        )
        response = self._transport.handle_request(request)
        content = bytearray()
        with closing(response):
            for part in response.iter_raw():
                content += part
                if len(content) > MAX_ANSWER_BYTES:
                    raise ServerLost(
                        f"{self._access.url} sent an answer of over {MAX_ANSWER_BYTES} bytes to "
                        f"{path}."
                    )
        return HttpAnswer(status=response.status_code, body=bytes(content))

    def _note_socket(self, event: str, facts: Mapping[str, Any]) -> None:
        """Called by the transport at each step of a request."""
        if event in _CONNECTED:
            self._socket = facts["return_value"].get_extra_info("socket")

    def cut(self) -> None:
        """Interrupt a request of another thread; no effect if there is none."""
        if self._socket is not None:
            with suppress(OSError):
                # not that of SSLSocket, which would remove the TLS state used by the other thread
                socket.socket.shutdown(self._socket, socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection."""
        self._transport.close()
