"""A client of openpi's websocket policy server: one request at a time, bounded waits, automatic
reconnection.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from rn_backend_openpi.wire import MOST_BYTES, Value, pack, unpack
from roboneuron import ConfigurationError, InvalidInputError, NotReadyError

Reply = dict[object, object] | NDArray[np.generic]
_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 1.0
_UNAUTHORIZED = (401, 403)
_NOT_HERE = (200, 400, 404, 405, 410, 426, 501)
"""Of a server of another kind, or at another path; it stays so."""
_SHOWN = 300
_CLOSE_TIMEOUT_S = 0.5
_RESET_DONE = "reset successful"
"""Reply to a reset. Source: roboarena policy_server.py."""
log = logging.getLogger(__name__)


class PolicyClient:
    """Client of openpi's policy protocol; used from one thread, except `close`.

    A failed request is never repeated: by then its images are old, and the caller has newer ones.
    The connection is dropped after every failure, so that a late answer cannot be mistaken for that
    of the next request.

    Args:
        url: "ws://host:port" or "wss://host:port", with a path if the server has one.
        api_key: sent as "Authorization: Api-Key ..."; None for none.
        ca_file: PEM of an authority that is trusted in addition to the system's; None for the
            system's only.
    """

    def __init__(
        self, url: str, *, api_key: str | None = None, ca_file: Path | None = None
    ) -> None:
        self._url = url
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        parts = urlsplit(url)
        self._tls = _tls(ca_file) if parts.scheme == "wss" else None
        self._address = (parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80))
        self._connection: Connection | None = None
        self._stack = ExitStack()
        self._closed = threading.Event()
        self.connections = 0
        """Number of connections made."""

    @property
    def is_connected(self) -> bool:
        """True if the connection exists and has neither failed nor been closed by the server, which
        some do when idle.
        """
        connection = self._connection
        return connection is not None and connection.state is State.OPEN

    def open(self, timeout_s: float) -> dict[object, object]:
        """Connect, with growing pauses between attempts; returns the server's metadata.

        Raises:
            NotReadyError: no server answered within `timeout_s`.
            ConfigurationError: the key is refused, or the other end does not speak the protocol.
        """
        self._drop()
        deadline_s = time.monotonic() + timeout_s
        pause_s, reason, was_answered = _FIRST_PAUSE_S, "no time was left", False
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            try:
                metadata = self._attempt(remaining_s)
            except (OSError, TimeoutError, WebSocketException) as error:
                self._drop()
                # the last attempt is cut short by the time limit, which is no reason
                if not (was_answered and isinstance(error, TimeoutError)):
                    reason, was_answered = _reason(error), isinstance(error, InvalidStatus)
                self._check_final(error)
            else:
                self.connections += 1
                return metadata
            if self._closed.wait(min(pause_s, max(0.0, deadline_s - time.monotonic()))):
                raise NotReadyError(f"The client of {self._url} was closed.")
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        what = "did not admit us" if was_answered else "did not answer"
        raise NotReadyError(
            f"The policy server at {self._url} {what} within {timeout_s:g} s: {reason}.",
            hint="Start it, or correct the option 'url'.",
        )

    def infer(self, request: Mapping[str, Value], timeout_s: float) -> Reply:
        """Send one request and return the reply. Must be connected.

        Raises:
            NotReadyError: the connection broke, the server reported a failure, or no reply came
                within `timeout_s`.
            ConfigurationError: the reply does not follow the protocol.
        """
        connection = self._connection
        if connection is None:
            raise NotReadyError(f"There is no connection to {self._url}.")
        try:
            reply = self._exchange(connection, request, timeout_s)
        except (OSError, WebSocketException) as error:
            self._drop()
            if isinstance(error, TimeoutError):
                raise NotReadyError(
                    f"The policy server at {self._url} gave no answer within {timeout_s:g} s.",
                    hint="It may be overloaded or gone; raise request_timeout_s if its inference "
                    "takes longer.",
                ) from error
            raise NotReadyError(
                f"The connection to {self._url} broke: {_reason(error)}."
            ) from error
        return self._decoded(reply)

    def reset(self, request: Mapping[str, Value], timeout_s: float) -> None:
        """Send one request whose answer only acknowledges it, as text or as a map. Raises
        NotReadyError as `infer` does.
        """
        connection = self._connection
        if connection is None:
            raise NotReadyError(f"There is no connection to {self._url}.")
        try:
            told = self._exchange(connection, request, timeout_s)
        except (OSError, WebSocketException) as error:
            self._drop()
            raise NotReadyError(f"The reset at {self._url} failed: {_reason(error)}.") from error
        if told != _RESET_DONE:
            self._decoded(told)

    def close(self) -> None:
        """Disconnect; may be called twice, and ends a wait in `open`."""
        self._closed.set()
        self._drop()

    def _exchange(
        self, connection: Connection, request: Mapping[str, Value], timeout_s: float
    ) -> str | bytes:
        """Send one frame and receive one. Raises TimeoutError when that takes longer."""
        deadline_s = time.monotonic() + timeout_s
        late = threading.Event()
        self._check_silent(connection)
        try:
            with _shut_after(connection.socket, timeout_s, late):
                connection.send(pack(request))
        except (OSError, WebSocketException) as error:
            if late.is_set():
                raise TimeoutError("the server does not read") from error
            raise
        return connection.recv(timeout=max(0.0, deadline_s - time.monotonic()))

    def _check_silent(self, connection: Connection) -> None:
        """Raise ConnectionError if an answer arrived before the request: openpi's answers have no
        number, so it would be taken for that of the request.
        """
        with suppress(TimeoutError):
            connection.recv(timeout=0)
            raise ConnectionAbortedError("the server sent an answer without a request")

    def _attempt(self, timeout_s: float) -> dict[object, object]:
        deadline_s = time.monotonic() + timeout_s
        # An own socket, without proxy or redirect: only the URL decides where images go and actions
        # come from.
        plain = socket.create_connection(self._address, timeout=timeout_s)
        plain.settimeout(None)
        self._stack.callback(plain.close)
        # No keep-alive pings: the server's event loop is blocked while it computes.
        connection = self._connection = self._stack.enter_context(
            connect(
                self._url,
                sock=plain,
                ssl=self._tls,
                additional_headers=self._headers,
                compression=None,
                max_size=MOST_BYTES,
                open_timeout=max(0.0, deadline_s - time.monotonic()),
                close_timeout=_CLOSE_TIMEOUT_S,
                ping_interval=None,
                proxy=None,
            )
        )
        try:
            told = connection.recv(timeout=max(0.0, deadline_s - time.monotonic()))
        except TimeoutError as error:
            raise TimeoutError("it accepted the connection, but sends no metadata") from error
        metadata = self._decoded(told)
        if not isinstance(metadata, dict):
            self._drop()
            raise ConfigurationError(
                f"{self._url} sends an array before any request; metadata are a map.",
                hint="Check that the URL is that of a policy server.",
            )
        return metadata

    def _decoded(self, frame: str | bytes) -> Reply:
        if isinstance(frame, str):
            self._drop()
            log.warning("policy server at %s failed:\n%s", self._url, frame)
            last = (frame.strip().splitlines() or ["no text"])[-1][:_SHOWN]
            raise NotReadyError(
                f"The policy server at {self._url} reported a failure: {last}", hint="See its log."
            )
        try:
            reply = unpack(frame)
        except InvalidInputError as error:
            self._drop()
            raise ConfigurationError(
                f"The policy server at {self._url} sent data that is not in openpi's format. "
                f"{error.message}",
                hint="Check that the URL is that of a policy server.",
            ) from error
        if isinstance(reply, dict) and reply.get("type") == "error":
            self._drop()
            told = str(reply.get("message") or reply.get("error") or "no text")[:_SHOWN]
            log.warning("policy server at %s failed: %s", self._url, told)
            raise NotReadyError(
                f"The policy server at {self._url} reported a failure: {told}", hint="See its log."
            )
        return reply

    def _check_final(self, error: Exception) -> None:
        """Raise ConfigurationError for a failure that waiting cannot resolve."""
        if isinstance(error, InvalidURI):
            raise ConfigurationError(
                f"{self._url!r} is not a websocket URL.", hint="Correct the option 'url'."
            ) from error
        if isinstance(error, ssl.SSLCertVerificationError):
            raise ConfigurationError(
                f"The certificate of {self._url} is not trusted: {error.verify_message}.",
                hint="Name the host as its certificate does, or name the authority's PEM file "
                "with ca_file.",
            ) from error
        if isinstance(error, InvalidStatus) and error.response.status_code in _UNAUTHORIZED:
            raise ConfigurationError(
                f"The policy server at {self._url} refused the key (HTTP "
                f"{error.response.status_code}).",
                hint="Set api_key_file to a file with a valid key.",
            ) from error
        if isinstance(error, InvalidStatus) and error.response.status_code in _NOT_HERE:
            raise ConfigurationError(
                f"{self._url} answers, but with HTTP {error.response.status_code}: there is no "
                "policy at this address.",
                hint="Correct the path in the option 'url': openpi's own server uses none, "
                "vLLM-Omni /v1/realtime/robot/openpi, SGLang /openpi/policy.",
            ) from error

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        stack, self._stack = self._stack, ExitStack()
        if connection is not None:
            # With a half-open peer an orderly close would block.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
        stack.close()


def _tls(ca_file: Path | None) -> ssl.SSLContext:
    """TLS context with the trusted authorities. Raises ConfigurationError if the file holds no
    certificate.
    """
    context = ssl.create_default_context()
    if ca_file is not None:
        try:
            context.load_verify_locations(ca_file)
        except (OSError, ssl.SSLError) as error:
            raise ConfigurationError(
                f"ca_file = {str(ca_file)!r} holds no certificate: {error}."
            ) from error
    return context


@contextmanager
def _shut_after(plain: socket.socket, timeout_s: float, late: threading.Event) -> Iterator[None]:
    """Shut the socket when the body takes longer than `timeout_s`, and set `late`.

    websockets bounds receiving but not sending: a peer that reads nothing would block it forever.
    """

    def shut() -> None:
        late.set()
        with suppress(OSError):
            plain.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(max(0.0, timeout_s), shut)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


def _reason(error: Exception) -> str:
    if isinstance(error, ConnectionClosed):
        return f"closed by the other end ({error})"
    return str(error) or type(error).__name__
