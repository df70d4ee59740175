"""One request to an HTTP endpoint, with a limit of time and size that nothing in the answer can
extend.
"""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Mapping
from contextlib import suppress
from http import HTTPStatus
from urllib.parse import SplitResult, urlsplit

from roboneuron import foreign
from roboneuron.errors import ConfigurationError, ForeignDataError, NotReadyError

_MOST_URL = 120
_KINDS: dict[str, type[http.client.HTTPConnection]] = {
    "http": http.client.HTTPConnection,
    "https": http.client.HTTPSConnection,
}


class HttpEndpoint:
    """An address that answers POST requests; no redirect and no proxy is followed.

    Args:
        url: "http://HOST:PORT/PATH" or "https://...".
        headers: of every request.

    Raises:
        ConfigurationError: the address is invalid.
    """

    def __init__(self, url: str, headers: Mapping[str, str]) -> None:
        self._headers = dict(headers)
        self._where = foreign.printable(url, _MOST_URL)
        try:
            self._parts: SplitResult = urlsplit(url)
            is_known = self._parts.scheme in _KINDS and bool(self._parts.hostname)
            is_known = is_known and self._parts.port != 0 and self._parts.username is None
        except ValueError:
            is_known = False
        if not is_known or not url.isascii() or any(one <= " " for one in url):
            raise ConfigurationError(f"url is {self._where!r}, expected http(s)://HOST:PORT/PATH.")

    def post(self, body: bytes, *, limit_s: float, most_bytes: int) -> bytes:
        """The body of the answer to a request; blocks for at most `limit_s`, but for the name
        service of the system.

        Raises:
            NotReadyError: it cannot be reached, is late, ends early, or answers with an error.
            ForeignDataError: the answer is too large.
        """
        connection = _KINDS[self._parts.scheme](
            self._parts.hostname or "", self._parts.port, timeout=limit_s
        )
        expiry = _Expiry(connection)
        timer = threading.Timer(limit_s, expiry.end)
        timer.daemon = True
        timer.start()
        try:
            answer = self._exchange(connection, expiry, body, most_bytes)
        except (OSError, http.client.HTTPException) as error:
            if expiry.is_over or isinstance(error, TimeoutError):
                raise self._late(limit_s) from error
            kind = type(error).__name__
            told = foreign.printable(str(error), _MOST_URL)
            raise NotReadyError(f"{self._where} does not answer: {kind} {told}.") from error
        finally:
            timer.cancel()
            connection.close()
        if expiry.is_over:
            raise self._late(limit_s)
        if len(answer) > most_bytes:
            raise self._large(most_bytes)
        return answer

    def _exchange(
        self,
        connection: http.client.HTTPConnection,
        expiry: _Expiry,
        body: bytes,
        most_bytes: int,
    ) -> bytes:
        connection.connect()
        expiry.watch(connection.sock)
        target = f"{self._parts.path or '/'}{f'?{self._parts.query}' if self._parts.query else ''}"
        connection.request("POST", target, body, self._headers)
        with connection.getresponse() as response:
            if response.status != HTTPStatus.OK:
                told = foreign.printable(response.reason or "", _MOST_URL)
                code = response.status
                raise NotReadyError(f"{self._where} answered {code} {told}".rstrip() + ".")
            if response.length is not None and response.length > most_bytes:
                raise self._large(most_bytes)
            answer = response.read(most_bytes + 1)
            if response.length and len(answer) <= most_bytes:
                raise http.client.IncompleteRead(answer, response.length)
            return answer

    def _late(self, limit_s: float) -> NotReadyError:
        return NotReadyError(
            f"{self._where} has not answered within {limit_s:g} s.",
            hint="Try again, or set a higher limit_s.",
        )

    def _large(self, most_bytes: int) -> ForeignDataError:
        return ForeignDataError(f"The answer of {self._where} is larger than {most_bytes} bytes.")


class _Expiry:
    """Ends a connection from the thread of a timer, whatever it is doing."""

    def __init__(self, connection: http.client.HTTPConnection) -> None:
        self._connection = connection
        # `watch` and `end` come on different threads. Either `end` finds the socket, or `watch`
        # finds that it is over; without the lock a connection made just then would never be ended.
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self.is_over = False

    def watch(self, used: socket.socket) -> None:
        """Watch the socket of the connection, which the connection forgets before its answer is
        read. Raises TimeoutError: the time is over.
        """
        with self._lock:
            self._socket = used
            if self.is_over:
                raise TimeoutError

    def end(self) -> None:
        """End it now."""
        with self._lock:
            self.is_over = True
            used = self._socket or self._connection.sock
        if used is not None:
            with suppress(OSError):
                used.shutdown(socket.SHUT_RDWR)
