"""One HTTP connection that is kept open, held to a deadline as a whole, and can be cut from another
thread.
"""

from __future__ import annotations

import http.client
import io
import select
import socket
import ssl
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from roboneuron import NotReadyError

MAX_ANSWER_BYTES = 4 << 20
"""No honest answer is longer."""
_LOCAL = ("127.0.0.1", "::1", "localhost")


class ServerLost(NotReadyError):
    """A server cannot be reached or hung up; another one may answer."""


class AnswerTooLate(NotReadyError):
    """The deadline passed before the answer was there."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Access:
    """How to reach a server.

    Attributes:
        url: "http://host:port" or "https://host:port".
        key: API key, empty for none.
        connect_timeout_s: bound on opening a connection [s].
        tls: what to check certificates with, for https.
    """

    url: str
    key: str
    connect_timeout_s: float
    tls: ssl.SSLContext | None = None

    @property
    def is_open_to_others(self) -> bool:
        """Whether requests and key cross a network in clear text."""
        parts = urlsplit(self.url)
        return parts.scheme == "http" and parts.hostname not in _LOCAL


@dataclass(frozen=True, kw_only=True, slots=True)
class HttpAnswer:
    """Status and body of an answer."""

    status: int
    body: bytes


class _TimedReader(io.RawIOBase):
    """Reads from a socket until a deadline, however the bytes trickle in."""

    def __init__(self, sock: socket.socket, deadline_s: float) -> None:
        super().__init__()
        self._sock = sock
        self._deadline_s = deadline_s

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        remaining_s = self._deadline_s - time.monotonic()
        if remaining_s <= 0:
            raise TimeoutError
        self._sock.settimeout(remaining_s)
        return self._sock.recv_into(buffer)


def _is_dropped(sock: socket.socket | None) -> bool:
    """Whether the other side has closed an idle connection, as servers do after a while."""
    if sock is None:
        return True
    readable = select.poll()  # select() knows no descriptor above 1023
    readable.register(sock, select.POLLIN)
    return bool(readable.poll(0))


class HttpConnection:
    """Used by one thread at a time; `cut` may be called from any."""

    def __init__(self, access: Access) -> None:
        self._access = access
        self._open: http.client.HTTPConnection | None = None
        self._deadline_s = 0.0

    def request(
        self, method: str, path: str, deadline_s: float, body: bytes | None = None
    ) -> HttpAnswer:
        """Send one request and read its answer.

        Args:
            method, path: "GET" or "POST" and where to.
            deadline_s: `time.monotonic()` by which the whole answer must be there.
            body: JSON, if any.

        Raises:
            ServerLost: no connection, or it broke.
            AnswerTooLate: the deadline passed.
        """
        if self._open is not None and _is_dropped(self._open.sock):
            self.close()
        url = self._access.url
        self._deadline_s = deadline_s
        try:
            connection = self._open = self._open or self._connect(deadline_s)
            assert connection.sock is not None
            connection.sock.settimeout(max(0.001, deadline_s - time.monotonic()))
            headers = {"Content-Type": "application/json"} if body is not None else {}
            if self._access.key:
                headers["Authorization"] = f"Bearer {self._access.key}"
            connection.request(method, path, body=body, headers=headers)
            response = connection.getresponse()
            content = response.read(MAX_ANSWER_BYTES)
            if not response.isclosed():
                raise ServerLost(
                    f"{url} sent an answer of over {MAX_ANSWER_BYTES} bytes to {path}."
                )
            if response.will_close:
                self.close()
            return HttpAnswer(status=response.status, body=content)
        except TimeoutError as error:
            self.close()
            raise AnswerTooLate(f"{url} did not answer {path} in time.") from error
        except (OSError, http.client.HTTPException, ValueError, AttributeError) as error:
            # ValueError and AttributeError: `cut` or `close` took the socket away meanwhile.
            self.close()
            text = str(error) or type(error).__name__
            raise ServerLost(f"{url} cannot be reached or hung up ({text}).") from error
        except ServerLost:
            self.close()
            raise

    def _connect(self, deadline_s: float) -> http.client.HTTPConnection:
        parts = urlsplit(self._access.url)
        assert parts.hostname is not None
        remaining_s = deadline_s - time.monotonic()
        if remaining_s <= 0:
            raise TimeoutError
        timeout_s = min(self._access.connect_timeout_s, remaining_s)
        connection: http.client.HTTPConnection
        if parts.scheme == "https":
            connection = http.client.HTTPSConnection(
                parts.hostname, parts.port, timeout=timeout_s, context=self._access.tls
            )
        else:
            connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=timeout_s)
        connection.response_class = self._make_response  # type: ignore[assignment]
        try:
            connection.connect()
        except TimeoutError as error:
            raise OSError(f"no connection within {timeout_s:.2f} s") from error
        connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def _make_response(self, sock: socket.socket, **options: Any) -> http.client.HTTPResponse:
        response = http.client.HTTPResponse(sock, **options)
        response.fp.close()
        response.fp = io.BufferedReader(_TimedReader(sock, self._deadline_s))
        return response

    def cut(self) -> None:
        """Break off a request that another thread is waiting for; harmless when there is none."""
        connection = self._open
        sock = None if connection is None else connection.sock
        if sock is not None:
            with suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Close the connection; the next request opens another one."""
        connection, self._open = self._open, None
        if connection is not None:
            with suppress(OSError):
                connection.close()
