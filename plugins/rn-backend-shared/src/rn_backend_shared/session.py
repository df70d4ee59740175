"""A robot's conversation with a server whose model is ready: one request at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rn_backend_shared import fields, wire
from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.frames import Document, FrameKind, Header
from rn_backend_shared.images import MOST_SIDE_PX, Rectangle
from roboneuron import (
    ActionChunk,
    ControlSpace,
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
)

LOADING, READY, FAILED = "loading", "ready", "failed"
"""States of a server."""
_MOST_OPEN = 64
"""Number of unanswered requests after which a connection is given up."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Welcome:
    """Welcome message of a server.

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
        document: the received message.
        number: number before that of the robot's first request; random for each connection to a
            policy server, so that a request is valid on one connection only.
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
    document: Document = field(default_factory=dict)
    number: int = 0

    @classmethod
    def of(cls, document: Document, number: int = 0) -> Welcome:
        """Parse a received message. Raises ForeignDataError."""
        space, refusal = document.get("space"), document.get("refusal")
        crops = fields.table(document.get("crops", {}), "crops", 16)
        sizes = fields.table(document.get("image_sizes", {}), "image sizes", 16)
        return cls(
            state=fields.text(fields.field(document, "state"), "state"),
            pid=fields.integer(fields.field(document, "pid"), "pid", 0),
            cameras=_roles(document, "cameras"),
            optional_cameras=_roles(document, "optional_cameras"),
            image_sizes={role: _size(size) for role, size in sizes.items()},
            crops={role: _rectangle(one) for role, one in crops.items()},
            continues=fields.truth(document.get("continues", False), "continues"),
            horizon=fields.integer(document.get("horizon", 1), "horizon", 1, wire.MOST_ROWS),
            step_s=fields.number(document.get("step_s", 0.0), "step_s", 0.0),
            most_committed=fields.integer(document.get("most_committed", 0), "most_committed", 0),
            takes_predicted_state=fields.truth(document.get("takes_state", False), "takes_state"),
            space=None if space is None else _space(space),
            refusal=None if refusal is None else fields.table(refusal, "a refusal", 8),
            failure=document if "error" in document else None,
            document=document,
            number=number,
        )


def _roles(document: Document, name: str) -> tuple[str, ...]:
    roles = fields.items(document.get(name, []), name, most=16)
    return tuple(fields.text(role, "a role", 64) for role in roles)


def _rectangle(value: object) -> Rectangle:
    left, top, *size = fields.items(value, "a crop", most=4, least=4)
    most = MOST_SIDE_PX
    found = fields.integer(left, "left", 0, most), fields.integer(top, "top", 0, most)
    return *found, *_size(size)


def _space(value: object) -> ControlSpace:
    try:
        return wire.to_space(value)
    except RoboNeuronError as error:
        raise ForeignDataError(f"the server sent an invalid control space: {error}") from error


def _size(value: object) -> tuple[int, int]:
    width, height = fields.items(value, "an image size", most=2, least=2)
    most = MOST_SIDE_PX
    return fields.integer(width, "a width", 1, most), fields.integer(height, "a height", 1, most)


def greet(channel: FrameChannel, hello: Document, timeout_s: float) -> Welcome:
    """Introduce a robot.

    Raises:
        OSError: the server is gone, or does not answer.
        ForeignDataError: the answer is invalid, or belongs to another hello;
            VersionError for another version.
    """
    asked = Header(FrameKind.HELLO, clock_ns=time.monotonic_ns())
    channel.send(asked, hello, timeout_s)
    received = channel.receive(time.monotonic() + timeout_s)
    header = received.header
    if header.kind is not FrameKind.WELCOME:
        raise ForeignDataError("the server does not introduce itself")
    if header.clock_ns != asked.clock_ns:
        raise ForeignDataError(
            "the introduction of the server was replayed: it answers another hello"
        )
    return Welcome.of(received.document(), header.number)


class ModelSession:
    """Sends requests over one connection; used from one thread, except `close`.

    Args:
        channel: to a server that is ready.
        welcome: its welcome message.
        base_s: round-trip time of that message [s].
    """

    def __init__(self, channel: FrameChannel, welcome: Welcome, base_s: float = 0.0) -> None:
        self._channel = channel
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
        began_ns, left_s = time.monotonic_ns(), deadline_s - time.monotonic()
        header = Header(FrameKind.REQUEST, self._number + 1, began_ns, left_s)
        if left_s <= 0:
            raise TimeoutError("the deadline has passed before the request")
        if len(self._open) >= _MOST_OPEN:
            raise ForeignDataError(f"the server left {_MOST_OPEN} requests without an answer")
        # a request that is not sent in time is cut, and the connection unusable
        self._channel.send(header, {"observation": observation}, left_s)
        self._number += 1  # after sending, because the server accepts only the next number
        self._open[header.number] = began_ns
        chunk = wire.to_answer(self._answer(header, deadline_s))
        round_trip_ms = (time.monotonic_ns() - began_ns) / 1e6
        inside_ms = sum(chunk.metrics.get(f"shared.{part}_ms", 0.0) for part in ("queue", "model"))
        own = {
            "shared.round_trip_ms": round_trip_ms,
            "shared.link_ms": max(round_trip_ms - inside_ms, 0.0),
        }
        return replace(chunk, metrics={**chunk.metrics, **own})

    def introduce(self, hello: Document, timeout_s: float) -> Welcome:
        """The welcome message for a robot's introduction; between two requests.

        Raises:
            OSError, ForeignDataError: as `greet`.
        """
        return greet(self._channel, hello, timeout_s)

    def _answer(self, asked: Header, deadline_s: float) -> Document:
        """The answer to this request. Each request is answered once: late answers to earlier
        requests are dropped, all others end the connection.
        """
        while True:
            received = self._channel.receive(deadline_s)
            header = received.header
            if header.kind is not FrameKind.ANSWER:
                raise ForeignDataError("the server sent a frame that is no answer")
            if self._open.pop(header.number, None) != header.clock_ns:
                raise ForeignDataError(
                    f"answer {header.number} was replayed: it has no request on this connection"
                )
            if header.number == asked.number:
                return received.document()

    def close(self) -> None:
        """Disconnect; idempotent."""
        self._channel.close()


def check_ready(welcome: Welcome) -> None:
    """Raise the error of a server that failed, or NotReadyError if it is not ready yet."""
    if welcome.failure is not None:
        wire.to_answer(welcome.failure)
    if welcome.state != READY:
        raise NotReadyError("The shared model is being loaded.")
