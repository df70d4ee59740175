"""A client of openpi's websocket policy server: one request at a time, bounded waits, automatic
reconnection.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import InvalidURI

from rn_backend_openpi.connection import HandshakeRefused, PolicyConnection
from rn_backend_openpi.messages import RESERVED
from rn_backend_openpi.security import authorization, trusting, tune
from rn_backend_openpi.session import READY
from rn_backend_openpi.wire import Value, pack, unpack
from roboneuron import ConfigurationError, ForeignDataError, NotReadyError

Reply = dict[object, object] | NDArray[np.generic]
_FIRST_PAUSE_S = 0.05
_LONGEST_PAUSE_S = 1.0
_UNAUTHORIZED = (401, 403)
_NOT_HERE = (200, 400, 404, 405, 410, 426, 501)
"""Of a server of another kind, or at another path; it stays so."""
_SHOWN = 300
_SILENT_S = 5.0
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
        self._headers = {"Authorization": authorization(api_key)} if api_key else {}
        parts = urlsplit(url)
        self._tls = (
            trusting(ssl.create_default_context(), ca_file) if parts.scheme == "wss" else None
        )
        self._address = (parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80))
        self._connection: PolicyConnection | None = None
        self._closed = threading.Event()
        self.connections = 0
        """Number of connections made."""

    @property
    def is_connected(self) -> bool:
        """True if the connection exists and has neither failed nor been closed by the server, which
        some do when idle.
        """
        return self._connection is not None and self._connection.is_open

    def open(self, timeout_s: float) -> dict[object, object]:
        """Connect, with growing pauses between attempts; returns the server's metadata.

        Raises:
            NotReadyError: no server answered within `timeout_s`.
            ConfigurationError: the key is refused, or the other end does not speak the protocol.
        """
        self._drop()
        deadline_s = time.monotonic() + timeout_s
        pause_s, reason, was_answered = _FIRST_PAUSE_S, "no time was left", False
        while time.monotonic() < deadline_s:
            try:
                metadata = self._attempt(deadline_s)
            except (OSError, ForeignDataError, InvalidURI) as error:
                self._drop()
                # the last attempt is cut short by the time limit, which is no reason
                if not (was_answered and isinstance(error, TimeoutError)):
                    reason = _reason(error)
                    was_answered = isinstance(error, (HandshakeRefused, ForeignDataError))
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
        return self._decoded(self._exchange(request, timeout_s))

    def reset(self, request: Mapping[str, Value], timeout_s: float) -> None:
        """Send one request whose answer only acknowledges it, as text or as a map. Raises
        NotReadyError as `infer` does.
        """
        told = self._exchange(request, timeout_s)
        if told != _RESET_DONE:
            self._decoded(told)

    def close(self) -> None:
        """Disconnect; may be called twice, and ends a wait in `open`."""
        self._closed.set()
        self._drop()

    def _exchange(self, request: Mapping[str, Value], timeout_s: float) -> str | bytes:
        """Send one message and receive one."""
        connection, deadline_s = self._connection, time.monotonic() + timeout_s
        if connection is None:
            raise NotReadyError(f"There is no connection to {self._url}.")
        try:
            # openpi's answers have no number, so it would be taken for that of the request
            if connection.has_message():
                raise ConnectionAbortedError("the server sent an answer without a request")
            connection.send(pack(request), deadline_s)
            return connection.receive(deadline_s)
        except TimeoutError as error:
            self._drop()
            raise NotReadyError(
                f"The policy server at {self._url} gave no answer within {timeout_s:g} s.",
                hint="It may be overloaded or gone; raise request_timeout_s if its inference "
                "takes longer.",
            ) from error
        except (OSError, ForeignDataError) as error:
            self._drop()
            raise NotReadyError(
                f"The connection to {self._url} broke: {_reason(error)}."
            ) from error

    def _attempt(self, deadline_s: float) -> dict[object, object]:
        # An own socket, without proxy or redirect: only the URL decides where images go and actions
        # come from.
        plain = socket.create_connection(self._address, timeout=deadline_s - time.monotonic())
        try:
            tune(plain, _SILENT_S)
            if self._tls is not None:
                plain = self._tls.wrap_socket(plain, server_hostname=self._address[0])
            connection = PolicyConnection(plain, self._url, self._headers)
        except BaseException:
            plain.close()
            raise
        self._connection = connection
        connection.open(deadline_s)
        try:
            told = connection.receive(deadline_s)
        except TimeoutError as error:
            raise TimeoutError("it accepted the connection, but sends no metadata") from error
        metadata = self._decoded(told)
        if not isinstance(metadata, dict):
            self._drop()
            raise ConfigurationError(
                f"{self._url} sends an array before any request; metadata are a map.",
                hint="Check that the URL is that of a policy server.",
            )
        own = metadata.get(RESERVED)
        if isinstance(own, dict) and own.get("state") != READY:
            raise ConnectionError(str(own.get("message", "its model is not loaded yet")))
        return metadata

    def _decoded(self, frame: str | bytes) -> Reply:
        if isinstance(frame, str):
            lines = frame.strip().splitlines() or ["no text"]
            raise self._failure(frame, lines[-1])
        try:
            reply = unpack(frame)
        except ForeignDataError as error:
            self._drop()
            raise ConfigurationError(
                f"The policy server at {self._url} sent data that is not in openpi's format. "
                f"{error.message}",
                hint="Check that the URL is that of a policy server.",
            ) from error
        # SGLang tells an error by its traceback alone, vLLM-Omni by a type and a message
        if isinstance(reply, dict) and (reply.get("type") == "error" or "error" in reply):
            told = str(reply.get("message") or reply.get("error") or "no text")
            raise self._failure(told, (told.strip().splitlines() or ["no text"])[-1])
        return reply

    def _failure(self, told: str, shown: str) -> NotReadyError:
        """Disconnect, log what the server told, and return the error that shows a part of it."""
        self._drop()
        log.warning("policy server at %s failed:\n%s", self._url, told)
        return NotReadyError(
            f"The policy server at {self._url} reported a failure: {shown[:_SHOWN]}",
            hint="See its log.",
        )

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
        if isinstance(error, HandshakeRefused) and error.status in _UNAUTHORIZED:
            raise ConfigurationError(
                f"The policy server at {self._url} refused the key (HTTP {error.status}).",
                hint="Set api_key_file to a file with a valid key.",
            ) from error
        if isinstance(error, HandshakeRefused) and error.status in _NOT_HERE:
            raise ConfigurationError(
                f"{self._url} answers, but with HTTP {error.status}: there is no "
                "policy at this address.",
                hint="Correct the path in the option 'url', or set `engine`, which has its own.",
            ) from error

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
