"""A robot's connection to the server of its model, with automatic reconnection."""

from __future__ import annotations

import logging
import socket
import ssl
import threading
import time
from collections.abc import Sequence
from http import HTTPStatus

from rn_backend_openpi.coding import Coder
from rn_backend_openpi.connection import HandshakeRefused, PolicyConnection
from rn_backend_openpi.introduction import from_profile
from rn_backend_openpi.links import LocalServer
from rn_backend_openpi.messages import Document, from_observation
from rn_backend_openpi.security import ServerAddress, authorization, link_stamps, place_of, tune
from rn_backend_openpi.session import (
    ModelLoadingError,
    ModelSession,
    Welcome,
    check_ready,
    receive,
)
from rn_backend_openpi.shared_options import SharedOptions
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    Observation,
    RoboNeuronError,
    RobotProfile,
)

log = logging.getLogger(__name__)
_CONNECT_S = 3.0
_GREET_S = 2.0
_DESCRIBE_S = 5.0
_REACH_S = 10.0
"""Longest wait for an unreachable server at the start; the wait for a loading one is longer."""
_LOOK_S, _LOCAL_LOOK_S = 0.2, 0.02
_FIRST_PAUSE_S, _LAST_PAUSE_S = 0.1, 2.0
_SILENT = 3
"""Number of consecutive deadlines without an answer after which the connection is replaced."""
_LEAST_SILENT_S = 1.0
_KEYS_S = 1.0
"""Period of checks for changed keys."""


class ModelLink:
    """Client of a server with an address, or of one on this machine, which is started if it is
    missing; used from one thread, except `close`.

    It never blocks a robot beyond the deadline of its observation: connections are made on another
    thread.

    Args:
        options: of the model.
    """

    def __init__(self, options: SharedOptions) -> None:
        self._options = options
        self._address = options.address or "on this machine"
        self._local = LocalServer(options) if options.address is None else None
        self._lock = threading.Lock()
        self._session: ModelSession | None = None
        self._connecting: threading.Thread | None = None
        self._coder: Coder | None = None
        self._reason = ""
        self._end = threading.Event()
        self._silent = 0
        self._stamps: Sequence[object] = ()
        self._looked_s = 0.0

    def open(self) -> Welcome:
        """Connect to the server, and wait until its model is ready; returns its description.

        Raises:
            ConfigurationError: keys, token, version or model differ from the server's.
            NotReadyError: it cannot be reached, or was not ready in time.
            RoboNeuronError: the server could not load its model.
        """
        begun_s = time.monotonic()
        while True:
            try:
                session = self._connect()
            except (OSError, NotReadyError) as error:
                self._check_patience(error, time.monotonic() - begun_s)
                self._end.wait(_LOOK_S if self._local is None else _LOCAL_LOOK_S)
                continue
            with self._lock:
                self._session = session
            told = session.welcome
            if self._local is None:
                self._coder = Coder(
                    self._options, told.image_sizes, session.base_s, crops=told.crops
                )
            return told

    def _check_patience(self, error: OSError | NotReadyError, waited_s: float) -> None:
        """Raise NotReadyError if a server that is not ready has been waited for long enough; start
        a missing one on this machine.
        """
        is_reached, hint = isinstance(error, NotReadyError), "Is `roboneuron serve-policy` running?"
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
                f"The server {self._address} of the shared model "
                + ("was not ready" if is_reached else "cannot be reached")
                + f" within {most_s:g} s: {error}",
                hint=hint,
            ) from error

    def describe(self, profile: RobotProfile) -> Welcome:
        """The server's description of its model for this robot; after `open`.

        Raises:
            NotReadyError: it does not answer.
        """
        with self._lock:
            session = self._session
        if session is None:
            raise NotReadyError(f"There is no connection to the server {self._address}.")
        try:
            return session.introduce(from_profile(profile), _DESCRIBE_S)
        except (OSError, ForeignDataError) as error:
            self._lose(str(error))
            raise NotReadyError(
                f"The server {self._address} does not describe its model: {error}."
            ) from error

    def ask(self, observation: Observation, deadline_s: float) -> ActionChunk:
        """Request the answer to an observation. On this machine images are sent as they are; to an
        address as a `Coder` decides, which measures its effect before the first one.

        Raises:
            ConfigurationError: the effect is too large.
            RoboNeuronError: as `exchange`.
        """
        if self._coder is None:
            return self.exchange(from_observation(observation), deadline_s)
        return self._coder.ask(observation, self.exchange, deadline_s)

    def exchange(self, observation: Document, deadline_s: float) -> ActionChunk:
        """Request the answer to an encoded observation.

        Raises:
            NotReadyError: no answer by the deadline (monotonic [s]), or there is no connection; a
                new one is being made.
            RoboNeuronError: the server's error for this observation.
        """
        self._leave_for_other_keys()
        with self._lock:
            session = self._session
        if session is None:
            self._begin_connecting()
            raise NotReadyError(
                f"There is no connection to the server {self._address} of the shared model; it is "
                f"being made. {self._reason}".rstrip()
            )
        try:
            chunk = session.ask(observation, deadline_s)
        except TimeoutError as error:
            self._silent += 1
            if self._silent >= _SILENT:
                self._lose("it did not answer")
            raise NotReadyError(
                f"The server {self._address} of the shared model did not answer before the "
                "deadline."
            ) from error
        except (OSError, ForeignDataError) as error:
            self._lose(str(error))
            raise NotReadyError(
                f"The connection to the server {self._address} of the shared model is lost: "
                f"{error}."
            ) from error
        self._silent = 0
        return chunk

    def _lose(self, reason: str) -> None:
        log.warning("The server %s of the shared model is lost: %s", self._address, reason)
        self._drop()
        self._begin_connecting()

    def _leave_for_other_keys(self) -> None:
        """Disconnect if keys of `roboneuron link` have changed, because the machine may have been
        removed.
        """
        now_s = time.monotonic()
        if not self._has_link_keys or now_s - self._looked_s < _KEYS_S:
            return
        self._looked_s = now_s
        if link_stamps() != self._stamps:
            self._drop()

    @property
    def _has_link_keys(self) -> bool:
        return self._local is None and self._options.token_file is None

    def _begin_connecting(self) -> None:
        if self._connecting is not None and self._connecting.is_alive():
            return
        self._connecting = threading.Thread(
            target=self._keep_connecting, name="connect", daemon=True
        )
        self._connecting.start()

    def _keep_connecting(self) -> None:
        pause_s = _FIRST_PAUSE_S
        while not self._end.is_set():
            try:
                session = self._connect()
            except (OSError, RoboNeuronError) as error:
                self._note(error)
                if self._local is not None and isinstance(error, OSError):
                    self._start_again(self._local)
            else:
                with self._lock:
                    is_wanted = not self._end.is_set()
                    self._session = session if is_wanted else None
                if not is_wanted:
                    session.close()
                self._reason, self._silent = "", 0
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
            log.warning("No connection to the server %s: %s", self._address, error)

    def _connect(self) -> ModelSession:
        """Connect to a server that is ready.

        Raises:
            OSError: it cannot be reached.
            ConfigurationError: it cannot be used.
            NotReadyError: it is not ready.
            RoboNeuronError: its model could not be loaded.
        """
        self._stamps = link_stamps() if self._has_link_keys else ()
        url, headers = "ws://localhost/", {}
        if self._local is not None:
            connected = self._local.connect()
        else:
            place = place_of(self._options)
            connected = self._secured(place)
            headers = {"Authorization": authorization(place.token)} if place.token else {}
            url = f"ws://{self._address}/{self._options.model or ''}"
        try:
            connection = PolicyConnection(connected, url, headers)
            begun_s = time.monotonic()
            welcome = self._greet(connection, begun_s + _GREET_S)
            check_ready(welcome)
            return ModelSession(connection, welcome, (time.monotonic() - begun_s) / 2)
        except BaseException:
            connected.close()
            raise

    def _secured(self, place: ServerAddress) -> socket.socket:
        connected = socket.create_connection((place.host, place.port), _CONNECT_S)
        try:
            tune(connected, max(self._options.timeout_s, _LEAST_SILENT_S))
            return connected if place.context is None else place.context.wrap_socket(connected)
        except ssl.SSLCertVerificationError as error:
            raise ConfigurationError(
                f"The server {self._address} has sent a certificate that is not trusted: "
                f"{error.verify_message}.",
                hint="Is it the machine that was paired? Pair it again with `roboneuron link`.",
            ) from error
        except BaseException:
            connected.close()
            raise

    def _greet(self, connection: PolicyConnection, deadline_s: float) -> Welcome:
        try:
            connection.open(deadline_s)
            return Welcome.of(receive(connection, deadline_s))
        except TimeoutError:
            raise
        except HandshakeRefused as error:
            raise self._refusal(error) from error
        except ConfigurationError:
            raise
        except (OSError, ForeignDataError) as error:
            raise ConnectionError(
                "it has closed the connection without an answer. Are the keys those of the server, "
                f"and is it one of `roboneuron serve-policy`? ({error})"
            ) from error

    def _refusal(self, error: HandshakeRefused) -> RoboNeuronError:
        if error.status == HTTPStatus.SERVICE_UNAVAILABLE:
            return NotReadyError(f"The server {self._address} refuses: {error.text}")
        if error.status == HTTPStatus.UNAUTHORIZED:
            return ConfigurationError(
                f"The server {self._address} refuses the token.",
                hint="token_file must hold the token of the server's [listen].",
            )
        return ConfigurationError(f"The server {self._address} refuses: {error.text or error}")

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
