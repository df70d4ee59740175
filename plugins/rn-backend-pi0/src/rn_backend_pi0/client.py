"""A client of openpi's websocket policy server: one request at a time, bounded waits, reconnects by
itself.
"""

from __future__ import annotations

import ipaddress
import logging
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidStatus, InvalidURI, WebSocketException
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from rn_backend_pi0.wire import Value, pack, unpack
from roboneuron import ConfigurationError, NotReadyError

_MAX_REPLY_BYTES = 64 * 2**20
_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 1.0
_UNAUTHORIZED = (401, 403)
_SHOWN = 300
_CLOSE_TIMEOUT_S = 0.5
log = logging.getLogger(__name__)


def is_loopback(host: str) -> bool:
    """Whether `host` is this machine, by its text alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class PolicyClient:
    """Speaks openpi's policy protocol; used from one thread, except `close`.

    A request that fails is never sent again: by then its images are old, and the caller has newer
    ones. The connection is dropped after every failure, so that a late answer is never taken for
    that of the next request.

    Args:
        url: "ws://host:port" or "wss://host:port".
        api_key: sent as "Authorization: Api-Key ..."; None for none.
    """

    def __init__(self, url: str, *, api_key: str | None = None) -> None:
        self._url = url
        self._headers = {"Authorization": f"Api-Key {api_key}"} if api_key else {}
        parts = urlsplit(url)
        self._address = (parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80))
        self._connection: Connection | None = None
        self._stack = ExitStack()
        self._closed = threading.Event()
        self.connections = 0
        """How often a connection was made."""

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection that has not failed yet."""
        return self._connection is not None

    def open(self, timeout_s: float) -> dict[object, object]:
        """Connect, with growing pauses between attempts; returns the server's metadata.

        Raises:
            NotReadyError: nobody answered within `timeout_s`.
            ConfigurationError: the key is refused, or the other end does not speak the protocol.
        """
        self._drop()
        deadline_s = time.monotonic() + timeout_s
        pause_s, reason = _FIRST_PAUSE_S, "no time was left"
        while (remaining_s := deadline_s - time.monotonic()) > 0:
            try:
                metadata = self._attempt(remaining_s)
            except (OSError, TimeoutError, WebSocketException) as error:
                self._drop()
                reason = _reason(error)
                self._check_final(error)
            else:
                self.connections += 1
                return metadata
            if self._closed.wait(min(pause_s, max(0.0, deadline_s - time.monotonic()))):
                raise NotReadyError(f"The client of {self._url} was closed.")
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
        raise NotReadyError(
            f"The policy server at {self._url} did not answer within {timeout_s:g} s: {reason}.",
            hint="Start it, or correct the option 'url'.",
        )

    def infer(self, request: Mapping[str, Value], timeout_s: float) -> dict[object, object]:
        """Send one request and return the reply. Must be connected.

        Raises:
            NotReadyError: the connection broke, the server reported a failure, or no reply came
                within `timeout_s`.
            ConfigurationError: the reply is not of the protocol.
        """
        connection = self._connection
        if connection is None:
            raise NotReadyError(f"There is no connection to {self._url}.")
        deadline_s = time.monotonic() + timeout_s
        late = threading.Event()
        try:
            with _shut_after(connection.socket, timeout_s, late):
                connection.send(pack(request))
            reply = connection.recv(timeout=max(0.0, deadline_s - time.monotonic()))
        except (OSError, WebSocketException) as error:
            self._drop()
            if late.is_set() or isinstance(error, TimeoutError):
                raise NotReadyError(
                    f"The policy server at {self._url} gave no answer within {timeout_s:g} s.",
                    hint="It may be overloaded or gone; raise request_timeout_s if its inference "
                    "takes longer.",
                ) from error
            raise NotReadyError(
                f"The connection to {self._url} broke: {_reason(error)}."
            ) from error
        return self._decoded(reply)

    def close(self) -> None:
        """Disconnect; may be called twice, and ends a wait in `open`."""
        self._closed.set()
        self._drop()

    def _attempt(self, timeout_s: float) -> dict[object, object]:
        deadline_s = time.monotonic() + timeout_s
        # A socket of our own: no proxy and no redirect, the URL alone says where images go and
        # actions come from.
        plain = socket.create_connection(self._address, timeout=timeout_s)
        plain.settimeout(None)
        self._stack.callback(plain.close)
        # No keep-alive pings: the server's loop is blocked while it computes.
        connection = self._connection = self._stack.enter_context(
            connect(
                self._url,
                sock=plain,
                additional_headers=self._headers,
                compression=None,
                max_size=_MAX_REPLY_BYTES,
                open_timeout=max(0.0, deadline_s - time.monotonic()),
                close_timeout=_CLOSE_TIMEOUT_S,
                ping_interval=None,
                proxy=None,
            )
        )
        return self._decoded(connection.recv(timeout=max(0.0, deadline_s - time.monotonic())))

    def _decoded(self, frame: str | bytes) -> dict[object, object]:
        if isinstance(frame, str):
            self._drop()
            log.warning("policy server at %s failed:\n%s", self._url, frame)
            last = (frame.strip().splitlines() or ["no text"])[-1][:_SHOWN]
            raise NotReadyError(
                f"The policy server at {self._url} reported a failure: {last}", hint="See its log."
            )
        try:
            return unpack(frame)
        except ConfigurationError:
            self._drop()
            raise

    def _check_final(self, error: Exception) -> None:
        """Raise for a failure that waiting cannot mend."""
        if isinstance(error, InvalidURI):
            raise ConfigurationError(
                f"{self._url!r} is not a websocket URL.", hint="Correct the option 'url'."
            ) from error
        if isinstance(error, ssl.SSLCertVerificationError):
            raise ConfigurationError(
                f"The certificate of {self._url} is not trusted: {error.verify_message}.",
                hint="Name the host as its certificate does, or add its authority with "
                "SSL_CERT_FILE.",
            ) from error
        if isinstance(error, InvalidStatus) and error.response.status_code in _UNAUTHORIZED:
            raise ConfigurationError(
                f"The policy server at {self._url} refused the key (HTTP "
                f"{error.response.status_code}).",
                hint="Set api_key_variable to the name of the environment variable that holds a "
                "valid key.",
            ) from error

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        stack, self._stack = self._stack, ExitStack()
        if connection is not None:
            # A peer that is half open would make an orderly close wait.
            with suppress(OSError):
                connection.socket.shutdown(socket.SHUT_RDWR)
        stack.close()


def check_url(url: str, *, has_key: bool, allow_insecure_key: bool) -> str:
    """Return a warning about `url`, empty when there is nothing to say.

    Raises:
        ConfigurationError: it has no host or holds a password, or a key would travel unencrypted.
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigurationError(f"The option 'url' cannot be read: {error}.") from error
    if not host or parts.username is not None:
        raise ConfigurationError(
            "The option 'url' must name a host and hold no user or password.",
            hint="A key goes into api_key_variable.",
        )
    if parts.scheme == "wss" or is_loopback(host):
        return ""
    if has_key and not allow_insecure_key:
        raise ConfigurationError(
            f"The API key would travel unencrypted to {host}.",
            hint="Use wss://, a tunnel, or allow_insecure_key = true.",
        )
    return (
        f"the connection to {host} is not encrypted: anyone on the way can read the images and "
        "change the robot's "
        "actions; use wss:// or a tunnel"
    )


@contextmanager
def _shut_after(plain: socket.socket, timeout_s: float, late: threading.Event) -> Iterator[None]:
    """Shut the socket when the body takes longer than `timeout_s`, and set `late`.

    websockets bounds receiving but not sending: a peer that reads nothing would block it for ever.
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
