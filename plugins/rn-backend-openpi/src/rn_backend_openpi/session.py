"""A robot's conversation with a server whose model is ready: one request at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rn_backend_openpi import fields, messages
from rn_backend_openpi.connection import PolicyConnection
from rn_backend_openpi.images import Rectangle
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import pack, unpack
from roboneuron import (
    MAX_SIDE_PX,
    ActionChunk,
    ConfigurationError,
    ControlSpace,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
)

PROTOCOL = 1
"""Version of the entries at `RESERVED`."""
LOADING, READY, FAILED = "loading", "ready", "failed"
"""States of a server."""
_MOST_OPEN = 64
"""Number of unanswered requests after which a connection is given up."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Welcome:
    """What a server's first message, or its answer to an introduction, has at `RESERVED`.

    Attributes:
        state: `LOADING`, `READY` or `FAILED`.
        pid: pid of its process.
        cameras: roles that the model needs.
        optional_cameras: roles that it uses if present.
        image_sizes: width and height [px], by role, to which the model itself shrinks images.
        crops: the part of a whole image that the server uses, by role.
        continues: chunks continue rows with a context that the server holds.
        horizon, step_s: rows of a chunk, and time between two [s], as declared by its backend.
        most_committed: see `BackendSpec.max_committed_rows`.
        takes_predicted_state: see `BackendSpec`.
        space: control space of its chunks on the introduced robot; None without an introduction.
        refusal: error if that robot cannot use it, as a document.
        failure: error if it failed, as a document; None in other states.
        number: number before that of the robot's first request; random for each connection, so
            that a request is valid on one connection only.
    """

    state: str
    pid: int
    cameras: tuple[str, ...] = ()
    optional_cameras: tuple[str, ...] = ()
    image_sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    crops: Mapping[str, Rectangle] = field(default_factory=dict)
    continues: bool = False
    horizon: int = 1
    step_s: float = 0.0
    most_committed: int = 0
    takes_predicted_state: bool = False
    space: ControlSpace | None = None
    refusal: Document | None = None
    failure: Document | None = None
    number: int = 0

    @classmethod
    def of(cls, document: Document) -> Welcome:
        """Parse a received message.

        Raises:
            ConfigurationError: the server is of another version, or of another kind.
            ForeignDataError: a field is malformed.
        """
        if RESERVED not in document:
            raise ConfigurationError(
                "The server is none of `roboneuron serve-policy`.",
                hint="The backend 'openpi' uses other servers of openpi's websocket.",
            )
        own = fields.table(document[RESERVED], RESERVED)
        if own.get("protocol") != PROTOCOL:
            raise ConfigurationError(
                f"The server uses version {own.get('protocol')!r} of RoboNeuron's entries, this "
                f"robot version {PROTOCOL}.",
                hint="Install the same release on both machines.",
            )
        space, refusal = own.get("space"), own.get("refusal")
        crops = fields.table(own.get("crops", {}), "crops", 16)
        sizes = fields.table(own.get("image_sizes", {}), "image sizes", 16)
        return cls(
            state=fields.text(fields.field(own, "state"), "state"),
            pid=fields.integer(fields.field(own, "pid"), "pid", 0),
            cameras=_roles(own, "cameras"),
            optional_cameras=_roles(own, "optional_cameras"),
            image_sizes={role: _size(size) for role, size in sizes.items()},
            crops={role: _rectangle(one) for role, one in crops.items()},
            continues=fields.truth(own.get("continues", False), "continues"),
            horizon=fields.integer(own.get("horizon", 1), "horizon", 1, messages.MOST_ROWS),
            step_s=fields.number(own.get("step_s", 0.0), "step_s", 0.0),
            most_committed=fields.integer(own.get("most_committed", 0), "most_committed", 0),
            takes_predicted_state=fields.truth(own.get("takes_state", False), "takes_state"),
            space=None if space is None else _space(space),
            refusal=None if refusal is None else fields.table(refusal, "a refusal", 8),
            failure=own if "error" in own else None,
            number=fields.integer(own.get("number", 0), "number", 0),
        )


def _roles(document: Document, name: str) -> tuple[str, ...]:
    roles = fields.items(document.get(name, []), name, most=16)
    return tuple(fields.text(role, "a role", 64) for role in roles)


def _rectangle(value: object) -> Rectangle:
    left, top, *size = fields.items(value, "a crop", most=4, least=4)
    most = MAX_SIDE_PX
    found = fields.integer(left, "left", 0, most), fields.integer(top, "top", 0, most)
    return *found, *_size(size)


def _space(value: object) -> ControlSpace:
    try:
        return messages.to_space(value)
    except RoboNeuronError as error:
        raise ForeignDataError(f"the server sent an invalid control space: {error}") from error


def _size(value: object) -> tuple[int, int]:
    width, height = fields.items(value, "an image size", most=2, least=2)
    most = MAX_SIDE_PX
    return fields.integer(width, "a width", 1, most), fields.integer(height, "a height", 1, most)


def receive(connection: PolicyConnection, deadline_s: float) -> Document:
    """The next message, a map.

    Raises:
        TimeoutError: none until the deadline (monotonic [s]).
        OSError: the server is gone.
        ForeignDataError: it sent something else.
    """
    data = connection.receive(deadline_s)
    if isinstance(data, str):
        raise ForeignDataError(f"the server reported a failure: {data.strip()[:300]}")
    return fields.table(unpack(data), "a message")


class ModelSession:
    """Sends requests over one connection; used from one thread, except `close`.

    Args:
        connection: to a server that is ready.
        welcome: its first message.
        base_s: time of a round trip of almost no data [s].
    """

    def __init__(self, connection: PolicyConnection, welcome: Welcome, base_s: float = 0.0) -> None:
        self._connection = connection
        self._number = welcome.number
        self._open: dict[int, int] = {}  # clock_ns of each unanswered request
        self.welcome = welcome
        self.base_s = base_s

    def ask(self, observation: Document, deadline_s: float) -> ActionChunk:
        """Request the answer to an observation; its metrics split the round-trip time.

        Raises:
            TimeoutError: no answer by the deadline (monotonic [s]); the next request may follow.
            OSError: the connection is unusable.
            ForeignDataError: likewise, for instance after an answer to no request.
            RoboNeuronError: the server's error for this observation.
        """
        began_ns = time.monotonic_ns()
        chunk = messages.to_answer(self._exchange(observation, deadline_s))
        round_trip_ms = (time.monotonic_ns() - began_ns) / 1e6
        inside_ms = sum(chunk.metrics.get(f"shared.{part}_ms", 0.0) for part in ("queue", "model"))
        own = {
            "shared.round_trip_ms": round_trip_ms,
            "shared.link_ms": max(round_trip_ms - inside_ms, 0.0),
        }
        return replace(chunk, metrics={**chunk.metrics, **own})

    def introduce(self, robot: Document, timeout_s: float) -> Welcome:
        """The server's description of its model for a robot, see `from_profile`.

        Raises:
            OSError, ForeignDataError, ConfigurationError: as `ask` and `Welcome.of`.
        """
        request = {RESERVED: {"robot": robot}}
        return Welcome.of(self._exchange(request, time.monotonic() + timeout_s))

    def _exchange(self, request: Document, deadline_s: float) -> Document:
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
            answer = receive(self._connection, deadline_s)
            told = fields.table(fields.field(answer, RESERVED), RESERVED)
            found = fields.integer(fields.field(told, "number"), "number")
            if self._open.pop(found, None) != fields.field(told, "clock_ns"):
                raise ForeignDataError(
                    f"answer {found} was replayed: it has no request on this connection"
                )
            if found == number:
                return answer

    def close(self) -> None:
        """Disconnect; idempotent."""
        self._connection.close()


class ModelLoadingError(NotReadyError):
    """The model of the server is being loaded."""


def check_ready(welcome: Welcome) -> None:
    """Raise the error of a server that failed, or ModelLoadingError if it is not ready yet."""
    if welcome.failure is not None:
        messages.raise_told(welcome.failure)
    if welcome.state != READY:
        raise ModelLoadingError("The shared model is being loaded.")
