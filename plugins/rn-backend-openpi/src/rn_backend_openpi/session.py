"""A robot's conversation over one connection to a server that is ready: one request at a time."""

from __future__ import annotations

import logging
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_backend_openpi import messages
from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.description import ServerDescription
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import Value, pack, unpack
from roboneuron import ActionChunk, ForeignDataError, foreign

Reply = dict[object, object] | NDArray[np.generic]
Request = dict[str, Value]
_MOST_OPEN = 64
"""Number of unanswered requests after which a connection is given up."""
_SHOWN = 300
_RESET_DONE = "reset successful"
"""Reply to a reset. Source: roboarena policy_server.py."""
log = logging.getLogger(__name__)


def receive(connection: PolicyConnection, deadline_s: float) -> Reply:
    """The next message.

    Raises:
        TimeoutError: none until the deadline (monotonic [s]).
        OSError: the server is gone.
        ForeignDataError: it sent something else, or the text of a failure, whose last line is
            shown and whose whole text is logged.
    """
    data = connection.receive(deadline_s)
    if isinstance(data, str):
        if data == _RESET_DONE:
            return {}
        raise _failure(data)
    reply = unpack(data)
    # SGLang tells an error by its traceback alone, vLLM-Omni by a type and a message
    if isinstance(reply, dict) and (reply.get("type") == "error" or "error" in reply):
        raise _failure(str(reply.get("message") or reply.get("error")))
    return reply


def _failure(told: str) -> ForeignDataError:
    log.warning("The policy server failed:\n%s", told)
    lines = told.strip().splitlines() or ["no text"]
    return ForeignDataError(f"it reported a failure: {lines[-1][:_SHOWN]}")


class PolicySession:
    """Sends requests over one connection; used from one thread, except `close`.

    Args:
        connection: to a server that is ready.
        description: its first message.
        base_s: time of a round trip of almost no data [s].
    """

    def __init__(
        self, connection: PolicyConnection, description: ServerDescription, base_s: float = 0.0
    ) -> None:
        self._connection = connection
        self._number = description.number
        self._open: dict[int, int] = {}  # clock_ns of each unanswered request
        self.description = description
        self.base_s = base_s

    @property
    def is_open(self) -> bool:
        """False if the server is gone, or has closed the connection, as some do when idle."""
        return self._connection.is_open

    def ask(self, observation: Document, deadline_s: float) -> ActionChunk:
        """Request the answer of our server; its metrics split the round-trip time.

        Raises:
            TimeoutError: no answer by the deadline (monotonic [s]); the next request may follow.
            OSError: the connection is unusable.
            ForeignDataError: likewise, for instance after an answer to no request.
            RoboNeuronError: the server's error for this observation.
        """
        began_ns = time.monotonic_ns()
        chunk = messages.to_answer(self._numbered(observation, deadline_s))
        round_trip_ms = (time.monotonic_ns() - began_ns) / 1e6
        inside_ms = sum(chunk.metrics.get(f"shared.{part}_ms", 0.0) for part in ("queue", "model"))
        own = {
            "shared.round_trip_ms": round_trip_ms,
            "shared.link_ms": max(round_trip_ms - inside_ms, 0.0),
        }
        return replace(chunk, metrics={**chunk.metrics, **own})

    def introduce(self, robot: Document, timeout_s: float) -> ServerDescription:
        """Our server's description of its model for a robot, see `from_profile`. Raises as `ask`
        and `ServerDescription.of`.
        """
        request = {RESERVED: {"robot": robot}}
        told = self._numbered(request, time.monotonic() + timeout_s)
        return ServerDescription.of(told)

    def exchange(self, request: Request, deadline_s: float) -> Reply:
        """The reply of any server of openpi's websocket. It has no number, so that a late one
        would be taken for the next: the connection is of no more use after an error.

        Raises:
            TimeoutError, OSError, ForeignDataError: as `ask`.
        """
        if self._connection.has_message():
            raise ConnectionAbortedError("the server sent an answer without a request")
        if self.description.is_ours:
            own = {"left_s": max(deadline_s - time.monotonic(), 0.0)}
            request = {**request, RESERVED: own}
        self._connection.send(pack(request), deadline_s)
        return receive(self._connection, deadline_s)

    def _numbered(self, request: Document, deadline_s: float) -> Document:
        """The answer to a request. Each request is answered once: late answers to earlier requests
        are dropped, all others end the connection.
        """
        clock_ns, left_s = time.monotonic_ns(), deadline_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("the deadline has passed before the request")
        if len(self._open) >= _MOST_OPEN:
            raise ForeignDataError(f"the server left {_MOST_OPEN} requests without an answer")
        number = self._number + 1
        named = {"number": number, "clock_ns": clock_ns, "left_s": left_s}
        own = {**request.get(RESERVED, {}), **named}
        # a request that is not sent in time is cut, and the connection unusable
        self._connection.send(pack({**request, RESERVED: own}), deadline_s)
        self._number = number
        self._open[number] = clock_ns
        while True:
            answer = foreign.table(receive(self._connection, deadline_s), "a message")
            told = foreign.table(foreign.field(answer, RESERVED), RESERVED)
            found = foreign.integer(foreign.field(told, "number"), "number")
            if self._open.pop(found, None) != foreign.field(told, "clock_ns"):
                raise ForeignDataError(
                    f"answer {found} was replayed: it has no request on this connection"
                )
            if found == number:
                return answer

    def close(self) -> None:
        """Disconnect; idempotent."""
        self._connection.close()
