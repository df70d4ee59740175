"""A robot's conversation with a server that has a model ready: one question at a time."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from rn_backend_shared import fields, wire
from rn_backend_shared.channel import Channel
from rn_backend_shared.frames import Document, FrameError, Header, Kind
from rn_backend_shared.images import MOST_SIDE_PX, Rectangle
from roboneuron import ActionChunk, ControlSpace, NotReadyError, RoboNeuronError

LOADING, READY, FAILED = "loading", "ready", "failed"
"""States of a server."""
_MOST_STRAY = 64
"""So many answers to nobody's question in a row, and the server is not talked to any longer."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Welcome:
    """What a server says of itself.

    Attributes:
        state: `LOADING`, `READY` or `FAILED`.
        pid: of its process.
        cameras: roles that the model needs.
        optional_cameras: roles that it uses where they are.
        image_sizes: width and height by role to which the model shrinks images itself [px].
        crops: what the server takes of an image that comes whole, by role.
        continues: chunks continue rows with a context that the server holds.
        horizon, step_s: rows of a chunk, and time between two [s], as its backend declares.
        most_committed: see `BackendSpec.max_committed_rows`.
        takes_predicted_state: see `BackendSpec`.
        space: of its chunks on the robot that has introduced itself; None: not asked.
        refusal: why that robot cannot use it, as a document.
        failure: why it failed, as a document; None for another state.
        document: all of it, as it came.
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

    @classmethod
    def of(cls, document: Document) -> Welcome:
        """What was sent; raises FrameError."""
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
        raise FrameError(f"the server tells a space that is none: {error}") from error


def _size(value: object) -> tuple[int, int]:
    width, height = fields.items(value, "an image size", most=2, least=2)
    most = MOST_SIDE_PX
    return fields.integer(width, "a width", 1, most), fields.integer(height, "a height", 1, most)


def greet(channel: Channel, hello: Document, timeout_s: float) -> Welcome:
    """Introduce a robot.

    Raises:
        OSError: the server is gone, or silent.
        FrameError: it says something else; a VersionError for another version.
    """
    channel.send(Header(Kind.HELLO), hello, timeout_s)
    received = channel.receive(time.monotonic() + timeout_s)
    if received.header.kind is not Kind.WELCOME:
        raise FrameError("the server does not introduce itself")
    return Welcome.of(received.document())


class Session:
    """Asks over one connection; used from one thread, except `close`.

    Args:
        channel: to a server that has said that it is ready.
        welcome: what it said.
        base_s: how long it took to say that [s].
    """

    def __init__(self, channel: Channel, welcome: Welcome, base_s: float = 0.0) -> None:
        self._channel = channel
        self._number = 0
        self.welcome = welcome
        self.base_s = base_s

    def ask(self, observation: Document, deadline_s: float) -> ActionChunk:
        """The answer to an observation, with the time of the round trip split up.

        Raises:
            TimeoutError: none by the deadline (monotonic [s]); the next one may be asked.
            OSError, FrameError: the connection is of no more use.
            RoboNeuronError: what the server says instead.
        """
        self._number += 1
        began_ns, left_s = time.monotonic_ns(), deadline_s - time.monotonic()
        header = Header(Kind.REQUEST, self._number, began_ns, left_s)
        if left_s <= 0:
            raise TimeoutError("the deadline is over before it is asked")
        # one that is not sent in time is cut: the next question finds the connection of no use
        self._channel.send(header, {"observation": observation}, left_s)
        chunk = wire.to_answer(self._answer(header, deadline_s))
        round_trip_ms = (time.monotonic_ns() - began_ns) / 1e6
        inside_ms = sum(chunk.metrics.get(f"shared.{part}_ms", 0.0) for part in ("queue", "model"))
        own = {
            "shared.round_trip_ms": round_trip_ms,
            "shared.link_ms": max(round_trip_ms - inside_ms, 0.0),
        }
        return replace(chunk, metrics={**chunk.metrics, **own})

    def introduce(self, hello: Document, timeout_s: float) -> Welcome:
        """What the server says to a robot that says more of itself; between two questions.

        Raises:
            OSError, FrameError: as `greet`.
        """
        return greet(self._channel, hello, timeout_s)

    def _answer(self, asked: Header, deadline_s: float) -> Document:
        """The answer to this question. Others belong to nobody: they are late, or repeated."""
        for _ in range(_MOST_STRAY):
            received = self._channel.receive(deadline_s)
            header = received.header
            if header.kind is not Kind.ANSWER:
                raise FrameError("the server sent what is no answer")
            if (header.number, header.clock_ns) == (asked.number, asked.clock_ns):
                return received.document()
        raise FrameError(f"the server sent {_MOST_STRAY} answers that nobody asked for")

    def close(self) -> None:
        """Hang up; idempotent."""
        self._channel.close()


def check_ready(welcome: Welcome) -> None:
    """Raise what a server that failed says, NotReadyError for one that is not ready yet."""
    if welcome.failure is not None:
        wire.to_answer(welcome.failure)
    if welcome.state != READY:
        raise NotReadyError("The shared model is being loaded.")
