"""A connection from the network: introduced first, then its frames are forwarded to the process of
its model.
"""

from __future__ import annotations

import logging
import secrets
import socket
import ssl
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

from rn_backend_shared import wire
from rn_backend_shared.channel import FrameChannel, Received
from rn_backend_shared.frames import Document, FrameKind, Header, VersionError
from rn_backend_shared.introduction import CLIENT, ROBOT
from rn_backend_shared.replicas import Replicas, Seat
from rn_backend_shared.security import Guard, client_of, tune, valid_until
from rn_backend_shared.session import FAILED
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
)

log = logging.getLogger(__name__)
HELLO_BYTES = 4096
"""Longest introduction in bytes."""
_REQUEST_BYTES = 1 << 25
_SEND_S = 2.0
_SILENT_S = 5.0
_SLICE_S = 0.5
_NUMBER_BITS = 62
"""Bits of the random number of a connection's first request."""
_GRACE_S = 0.1
"""Time after its deadline up to which an answer is still forwarded, so that the robot can count
it.
"""


class VisitorServer(Protocol):
    """The server that a visitor uses."""

    def admit(self, visitor: Visitor, hello: Document) -> Replicas:
        """Admit an introduced robot and return its model. Raises ConnectionError or
        ConfigurationError for a refused one.
        """

    def leave(self, visitor: Visitor, why: str) -> None:
        """Remove a disconnected visitor."""

    def note_served(self, model: str, took_s: float) -> None:
        """Note the time from a complete observation to its answer [s]."""

    def note_lost(self, model: str) -> None:
        """Count an observation that was lost because its model was not available."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Patience:
    """Time limits of a visitor.

    Attributes:
        admit_s: for handshake and introduction [s].
        frame_s: for receiving a whole frame [s].
    """

    admit_s: float
    frame_s: float


class Visitor:
    """One connection from the network, served on its own thread.

    Args:
        server: the policy server.
        guard: adds TLS to the socket if keys are required.
        connected: its socket.
        address: address of the peer.
        patience: its time limits.

    Attributes:
        client: identity of the peer, see `client_of`.

    Raises:
        OSError: no connection is admitted.
    """

    def __init__(
        self,
        server: VisitorServer,
        guard: Guard,
        connected: socket.socket,
        address: str,
        patience: Patience,
    ) -> None:
        self.address = address
        self.client = client_of(address)
        self._server = server
        self._patience = patience
        tune(connected, _SILENT_S)
        connected.settimeout(patience.admit_s)
        self._connected = guard.wrap(connected)
        self._channel: FrameChannel | None = None
        self._expires: datetime | None = None
        self._seat: Seat | None = None
        self._last = secrets.randbits(_NUMBER_BITS)

    def serve(self) -> None:
        """Serve the visitor until it disconnects."""
        why = "it was refused"
        try:
            if isinstance(self._connected, ssl.SSLSocket):
                self._connected.do_handshake()
            self._expires = valid_until(self._connected)
            self.client = client_of(self.address, self._connected)
            channel = self._channel = FrameChannel(self._connected, HELLO_BYTES)
            received = channel.receive(time.monotonic() + self._patience.admit_s)
            if received.header.kind is not FrameKind.HELLO:
                raise ForeignDataError("it has not introduced itself")
            try:
                model = self._server.admit(self, received.document())
            except ForeignDataError:  # it is not of this protocol and gets no answer
                raise
            except RoboNeuronError as error:
                refusal = {"state": FAILED, "pid": 0, **wire.from_answer(error)}
                told = Header(FrameKind.WELCOME, clock_ns=received.header.clock_ns)
                channel.send(told, refusal, _SEND_S)
                raise ForeignDataError(str(error)) from error
            channel.most_bytes = _REQUEST_BYTES
            log.info("A robot at %s uses the model %s.", self.address, model.name)
            self._welcome(channel, model, received)
            while True:
                self._take(channel, model, self._next(channel))
        except VersionError as error:
            why = str(error)
            self._refuse_version(error)
        except (OSError, ForeignDataError) as error:
            why = str(error)
        finally:
            self.close(why)

    def close(self, why: str) -> None:
        """Disconnect and leave the server; called by `serve`, or instead of it."""
        self._server.leave(self, why)
        self._leave_seat()
        if self._channel is not None:
            self._channel.close()
        self._connected.close()

    def _refuse_version(self, error: VersionError) -> None:
        """Report the version only to a peer with a valid key."""
        if self._expires is None or self._channel is None:
            return
        refusal = ConfigurationError(f"The policy server refuses: {error}.")
        with suppress(OSError):
            self._channel.send(Header(FrameKind.ANSWER), wire.from_answer(refusal), _SEND_S)

    def interrupt(self) -> None:
        """End the connection, from another thread."""
        with suppress(OSError):
            # the method of SSLSocket would continue unencrypted
            socket.socket.shutdown(self._connected, socket.SHUT_RDWR)

    def _next(self, channel: FrameChannel) -> Received:
        """The next frame; waits any time for it to begin.

        Raises:
            OSError: the connection has ended, its certificate has expired, or a frame takes too
                long.
        """
        while True:
            with suppress(TimeoutError):
                return channel.receive(time.monotonic() + _SLICE_S)
            begun_s = channel.begun_s
            if begun_s is not None and time.monotonic() - begun_s > self._patience.frame_s:
                raise ConnectionError("a frame has not arrived completely in time")
            if self._expires is not None and datetime.now(UTC) > self._expires:
                raise ConnectionError("its certificate has expired")

    def _take(self, channel: FrameChannel, model: Replicas, received: Received) -> None:
        header = received.header
        if header.kind is FrameKind.HELLO:
            self._welcome(channel, model, received)
            return
        if header.kind is not FrameKind.REQUEST:
            raise ForeignDataError(f"a frame of kind {header.kind} was not expected")
        if header.number != self._last + 1:
            raise ForeignDataError(
                f"request {header.number} was replayed, lost or from another connection: "
                f"{self._last + 1} comes next"
            )
        self._last = header.number
        begun_s = time.monotonic()
        try:
            answer = self._carry(model, received)
        except NotReadyError as error:
            self._server.note_lost(model.name)
            told = Header(FrameKind.ANSWER, header.number, header.clock_ns)
            channel.send(told, wire.from_answer(error), _SEND_S)
        else:
            self._server.note_served(model.name, time.monotonic() - begun_s)
            channel.send_parts([answer.header.pack(), answer.body], _SEND_S)

    def _welcome(self, channel: FrameChannel, model: Replicas, received: Received) -> None:
        """Forward the welcome message of the model's process."""
        hello = received.document()
        told: Mapping[str, object] = model.welcome()
        own = {ROBOT: hello[ROBOT]} if ROBOT in hello else {}
        with suppress(NotReadyError):
            told = self._take_seat(model, hello=own).welcome.document
        header = Header(FrameKind.WELCOME, self._last, received.header.clock_ns)
        channel.send(header, told, _SEND_S)

    def _take_seat(
        self, model: Replicas, avoided: int | None = None, hello: Document | None = None
    ) -> Seat:
        """Connect to a replica of the model. Raises NotReadyError if none is ready."""
        self._leave_seat()
        self._seat = model.take_seat({**(hello or {}), CLIENT: self.client}, avoided=avoided)
        return self._seat

    def _leave_seat(self) -> None:
        seat, self._seat = self._seat, None
        if seat is not None:
            seat.leave()

    def _carry(self, model: Replicas, received: Received) -> Received:
        """The model's answer to a request. If its replica dies meanwhile, one other replica is
        used; only one, because an observation that crashes a process must not end them all.

        Raises:
            NotReadyError: the replica has died, is not ready, or does not answer by the deadline.
        """
        deadline_s = time.monotonic() + received.header.left_s
        if self._seat is not None and self._seat.is_crowded:
            self._leave_seat()
        seat = self._seat or self._take_seat(model)
        try:
            return _asked(seat.channel, received, deadline_s)
        except TimeoutError as error:
            if len(model.processes) > 1:  # it may hang: another replica is used next
                with suppress(NotReadyError):
                    self._take_seat(model, seat.replica)
            raise NotReadyError(
                f"The model {model.name!r} did not answer before the deadline."
            ) from error
        except (OSError, ForeignDataError) as error:
            self._leave_seat()
            refusal = NotReadyError(f"The model {model.name!r} has died; the server restarts it.")
            if len(model.processes) == 1 or time.monotonic() > deadline_s:
                raise refusal from error
            log.warning("Replica %d of the model %s has died.", seat.replica, model.name)
        other = self._take_seat(model, seat.replica)
        try:
            return _asked(other.channel, received, deadline_s)
        except TimeoutError as error:
            raise NotReadyError(
                f"The model {model.name!r} did not answer before the deadline."
            ) from error
        except (OSError, ForeignDataError) as error:
            self._leave_seat()
            raise refusal from error


def _asked(channel: FrameChannel, received: Received, deadline_s: float) -> Received:
    """Forward a request to a process and return its answer. Raises OSError or ForeignDataError."""
    header = received.header
    left_s = deadline_s - time.monotonic()
    told = header._replace(left_s=max(left_s, 0.0))
    channel.send_parts([told.pack(), received.body], left_s)
    while True:
        answer = channel.receive(deadline_s + _GRACE_S)
        found = answer.header
        if (found.number, found.clock_ns) == (header.number, header.clock_ns):
            return answer
