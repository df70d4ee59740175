"""A robot's connection to the server of its policy, with automatic reconnection."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

from websockets.exceptions import InvalidURI

from rn_backend_openpi.connection import HandshakeRefused, PolicyConnection
from rn_backend_openpi.description import ModelLoadingError, ServerDescription
from rn_backend_openpi.introduction import from_profile
from rn_backend_openpi.links import LocalServer
from rn_backend_openpi.messages import Document
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.security import (
    ServerAddress,
    authorization,
    has_link_keys,
    link_stamps,
    place_of,
    tune,
)
from rn_backend_openpi.session import PolicySession, Reply, Request, receive
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
    RobotProfile,
)

log = logging.getLogger(__name__)
Answer = TypeVar("Answer")
_CONNECT_S = 3.0
_GREET_S = 2.0
_DESCRIBE_S = 5.0
_REACH_S = 10.0
"""Longest wait for an unreachable server at the start; the wait for a loading one is longer."""
_LOOK_S, _LOCAL_LOOK_S = 0.2, 0.02
_FIRST_PAUSE_S, _LAST_PAUSE_S = 0.1, 2.0
_FRESH_S = 0.2
"""Longest wait of an observation for a new connection to a server that closes idle ones; a later
one needs a newer observation.
"""
_SILENT = 3
"""Number of consecutive deadlines without an answer after which the connection is replaced."""
_LEAST_SILENT_S = 1.0
_KEYS_S = 1.0
"""Period of checks for changed keys."""
_UNAUTHORIZED = (401, 403)
_NOT_HERE = (200, 400, 404, 405, 410, 426, 501)
"""Of a server of another kind, or at another path; it stays so."""


class PolicyClient:
    """Client of a policy server at a URL or an address, or of one on this machine, which is started
    if it is missing; used from one thread, except `close`.

    It never blocks a robot beyond the deadline of its observation: connections are made on another
    thread. A failed request is never repeated: by then its images are old.

    Args:
        options: of the policy.
    """

    def __init__(self, options: PolicyOptions) -> None:
        self._options = options
        self._name = options.url or options.address or "on this machine"
        self._local = LocalServer(options) if options.is_local else None
        self._lock = threading.Lock()
        self._session: PolicySession | None = None
        self._connecting: threading.Thread | None = None
        self._connected = threading.Event()
        self._reason = ""
        self._end = threading.Event()
        self._silent = 0
        self._stamps: Sequence[object] = ()
        self._looked_s = 0.0
        self.warning = ""
        """What a person should know about the connection; empty for nothing."""
        self.connections = 0
        """Number of connections made."""

    def open(self) -> PolicySession:
        """Connect to the server, and wait until its model is ready.

        Raises:
            ConfigurationError: keys, token, version, path or model differ from the server's.
            NotReadyError: it cannot be reached, or was not ready in time.
            RoboNeuronError: the server could not load its model.
        """
        begun_s = time.monotonic()
        until_s = begun_s + min(_REACH_S, self._options.start_timeout_s)
        reason: Exception | None = None
        while True:
            try:
                session = self._connect(until_s)
            except (OSError, ForeignDataError, NotReadyError) as error:
                # an attempt that the limit has cut short is no reason
                if reason is None or not isinstance(error, TimeoutError):
                    reason = error
                self._check_patience(reason, time.monotonic() - begun_s)
                self._end.wait(_LOOK_S if self._local is None else _LOCAL_LOOK_S)
                until_s = max(until_s, time.monotonic() + _GREET_S)
            else:
                with self._lock:
                    self._session = session
                return session

    def _check_patience(self, error: Exception, waited_s: float) -> None:
        """Raise NotReadyError if a server that is not ready has been waited for long enough; start
        a missing one on this machine.
        """
        is_reached = isinstance(error, NotReadyError)
        hint = "Is it running, and is this its address?"
        most_s = self._options.start_timeout_s
        if self._local is not None:
            hint = f"Its log is {self._local.path.with_suffix('.log')}."
            if not is_reached:
                self._local.start()
            elif not isinstance(error, ModelLoadingError):
                raise error
        elif not is_reached:
            most_s = min(_REACH_S, most_s)
        if waited_s > most_s:
            raise NotReadyError(
                f"The policy server {self._name} "
                + ("was not ready" if is_reached else "cannot be reached")
                + f" within {most_s:g} s: {_reason(error)}",
                hint=hint,
            ) from error

    def describe(self, profile: RobotProfile) -> ServerDescription:
        """Our server's description of its model for this robot; after `open`.

        Raises:
            NotReadyError: it does not answer.
        """
        introduced = from_profile(profile)
        return self._asked(lambda session: session.introduce(introduced, _DESCRIBE_S), _DESCRIBE_S)

    def ask(self, observation: Document, deadline_s: float) -> ActionChunk:
        """Request the answer of our server to an encoded observation.

        Raises:
            NotReadyError: no answer by the deadline (monotonic [s]), or there is no connection; a
                new one is being made.
            RoboNeuronError: the server's error for this observation.
        """
        return self._asked(
            lambda session: session.ask(observation, deadline_s),
            deadline_s - time.monotonic(),
        )

    def exchange(self, request: Request, deadline_s: float) -> Reply:
        """The reply of any server to a request; raises NotReadyError as `ask`."""
        return self._asked(
            lambda session: session.exchange(request, deadline_s),
            deadline_s - time.monotonic(),
            is_numbered=False,
        )

    def _asked(
        self, ask: Callable[[PolicySession], Answer], left_s: float, *, is_numbered: bool = True
    ) -> Answer:
        self._leave_for_other_keys()
        session = self._ready_session(left_s, is_numbered=is_numbered)
        try:
            answer = ask(session)
        except TimeoutError as error:
            self._silent += 1
            # a late answer without a number would be taken for the next one
            if self._silent >= _SILENT or not is_numbered:
                self._lose("it did not answer")
            raise NotReadyError(
                f"The policy server {self._name} gave no answer within {left_s:.3g} s.",
                hint="It may be overloaded or gone; raise timeout_s if its inference takes longer.",
            ) from error
        except (OSError, ForeignDataError) as error:
            self._lose(_reason(error))
            raise NotReadyError(
                f"The connection to the policy server {self._name} is lost: {_reason(error)}.",
                hint="It is made anew. See the server's log.",
            ) from error
        self._silent = 0
        return answer

    def _ready_session(self, left_s: float, *, is_numbered: bool) -> PolicySession:
        """The connection, made anew if it is lost. Raises NotReadyError."""
        with self._lock:
            session = self._session
        # others close an idle connection, which is no fault; ours does it to a replayed request
        if session is not None and not is_numbered and not session.is_open:
            self._drop()
            session = None
        if session is None:
            self._begin_connecting()
            if not is_numbered:  # a robot of ours with a fallback must not be held up
                self._connected.wait(max(min(left_s, _FRESH_S), 0.0))
            with self._lock:
                session = self._session
        if session is None:
            raise NotReadyError(
                f"There is no connection to the policy server {self._name}; it is being made. "
                f"{self._reason}".rstrip()
            )
        return session

    def _lose(self, reason: str) -> None:
        log.warning("The policy server %s is lost: %s", self._name, reason)
        self._drop()
        self._begin_connecting()

    def _leave_for_other_keys(self) -> None:
        """Disconnect if keys of `roboneuron link` have changed, because the machine may have been
        removed.
        """
        now_s = time.monotonic()
        if not has_link_keys(self._options) or now_s - self._looked_s < _KEYS_S:
            return
        self._looked_s = now_s
        if link_stamps() != self._stamps:
            self._drop()

    def _begin_connecting(self) -> None:
        if self._connecting is not None and self._connecting.is_alive():
            return
        self._connected.clear()
        self._connecting = threading.Thread(
            target=self._keep_connecting, name="connect", daemon=True
        )
        self._connecting.start()

    def _keep_connecting(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._end.is_set():
            try:
                session = self._connect(time.monotonic() + _GREET_S)
            except (OSError, RoboNeuronError) as error:
                self._note(error)
                if self._local is not None and isinstance(error, OSError):
                    self._start_again(self._local)
            else:
                self._reason, self._silent = "", 0
                with self._lock:
                    is_wanted = not self._end.is_set()
                    self._session = session if is_wanted else None
                if not is_wanted:
                    session.close()
                self._connected.set()
                return
            self._end.wait(pause_s)
            pause_s = min(2 * pause_s, _LAST_PAUSE_S)

    def _start_again(self, server: LocalServer) -> None:
        try:
            server.start()
        except ConfigurationError as error:
            self._note(error)

    def _note(self, error: Exception) -> None:
        if str(error) != self._reason:
            self._reason = str(error)
            log.warning("No connection to the policy server %s: %s", self._name, error)

    def _connect(self, deadline_s: float) -> PolicySession:
        """Connect to a server that is ready, until a deadline (monotonic [s]).

        Raises:
            OSError, ForeignDataError: it cannot be reached.
            ConfigurationError: it cannot be used.
            NotReadyError: it is not ready.
            RoboNeuronError: its model could not be loaded.
        """
        self._stamps = link_stamps() if has_link_keys(self._options) else ()
        url, headers = "ws://localhost/", {}
        if self._local is not None:
            connected = self._local.connect()
        else:
            place = place_of(self._options)
            self._warn(place.warning)
            connected = self._secured(place, deadline_s)
            headers = {"Authorization": authorization(place.token)} if place.token else {}
            url = place.url
        try:
            connection = PolicyConnection(connected, url, headers)
            begun_s = time.monotonic()
            description = self._greet(connection, deadline_s)
            description.check_ready()
            self.connections += 1
            return PolicySession(connection, description, (time.monotonic() - begun_s) / 2)
        except InvalidURI as error:
            connected.close()
            raise ConfigurationError(
                f"{url!r} is not a websocket URL.", hint="Correct the option 'url'."
            ) from error
        except BaseException:
            connected.close()
            raise

    def _warn(self, warning: str) -> None:
        if warning != self.warning:
            log.warning("%s", warning)
        self.warning = warning

    def _secured(self, place: ServerAddress, deadline_s: float) -> socket.socket:
        # an own socket, without proxy or redirect: only the options decide where images go and
        # actions come from
        left_s = max(min(_CONNECT_S, deadline_s - time.monotonic()), 0.1)
        connected = socket.create_connection((place.host, place.port), left_s)
        try:
            tune(connected, max(self._options.timeout_s, _LEAST_SILENT_S))
            if place.context is None:
                return connected
            return place.context.wrap_socket(connected, server_hostname=place.host)
        except ssl.SSLCertVerificationError as error:
            raise ConfigurationError(
                f"The server {self._name} has sent a certificate that is not trusted: "
                f"{error.verify_message}.",
                hint="Name the authority's PEM file with ca_file, and the host as the certificate "
                "does; pair a machine of `roboneuron link` again.",
            ) from error
        except BaseException:
            connected.close()
            raise

    def _greet(self, connection: PolicyConnection, deadline_s: float) -> ServerDescription:
        try:
            connection.open(deadline_s)
        except HandshakeRefused as error:
            raise self._refusal(error) from error
        except TimeoutError:
            raise
        except (OSError, ForeignDataError) as error:
            raise ConnectionError(
                "it has closed the connection without an answer. Are the keys those of the server, "
                f"and is it a policy server? ({_reason(error)})"
            ) from error
        try:
            told = receive(connection, deadline_s)
        except TimeoutError as error:
            raise ConnectionError(
                "it accepted the connection, but sends no first message"
            ) from error
        if not isinstance(told, dict):
            raise ForeignDataError("its first message is an array, no map")
        return ServerDescription.of(told)

    def _refusal(self, error: HandshakeRefused) -> RoboNeuronError | OSError:
        told = f"The policy server {self._name} refuses: {error}."
        if error.status in _UNAUTHORIZED:
            return ConfigurationError(
                f"The policy server {self._name} refused the key (HTTP {error.status}).",
                hint="Set token_file to a file with the key or token of the server.",
            )
        if error.status in _NOT_HERE:
            return ConfigurationError(
                f"{told} There is no policy at this address.",
                hint="Correct `model` or the path of the url, or set `engine`, which has its own.",
            )
        return NotReadyError(told)

    def _drop(self) -> None:
        with self._lock:
            session, self._session = self._session, None
        if session is not None:
            session.close()

    def close(self) -> None:
        """Disconnect; idempotent."""
        self._end.set()
        self._drop()
        if self._connecting is not None:
            self._connecting.join(_CONNECT_S + _GREET_S)


def _reason(error: Exception) -> str:
    return str(error).rstrip(".") or type(error).__name__
