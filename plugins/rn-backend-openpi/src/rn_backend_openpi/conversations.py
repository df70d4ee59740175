"""Conversations of a served model with its clients: messages in, answers out."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from rn_backend_openpi.batching import Answer
from rn_backend_openpi.listener import send
from rn_backend_openpi.wire import Value, pack
from roboneuron import (
    InvalidInputError,
    NotReadyError,
    Observation,
    RoboNeuronError,
    UngroundedError,
    UnsafeError,
)

_GRACE_S = 0.5
"""Time after its deadline at which an answer counts as late."""
IDLE_S = 600.0
"""Time without a request after which a client of openpi's kind is disconnected."""
_MOST_OPEN = 4
"""Requests of a connection that are answered at the same time; a further one is not read yet."""
_TOLD = (InvalidInputError, UngroundedError, UnsafeError, NotReadyError)
"""Errors of one observation, whose text is sent to every client; others may contain paths of the
server.
"""
log = logging.getLogger(__name__)
Reply = Mapping[str, Value]


@dataclass(frozen=True, kw_only=True, slots=True)
class PolicyRequest:
    """One request, decoded.

    Attributes:
        observation: input of the backend.
        left_s: time within which an answer is useful [s].
        number: of the client; None if it does not number its requests.
        clock_ns: the client's clock at the request, to be repeated.
    """

    observation: Observation
    left_s: float
    number: int | None = None
    clock_ns: int = 0


class Conversation(Protocol):
    """One client's conversation with a served model."""

    def first(self) -> Reply:
        """The server's first message."""

    async def read(self, data: str | bytes) -> PolicyRequest | Reply:
        """Decode a request, or answer it at once; one at a time.

        Raises:
            RoboNeuronError: it is malformed, or of another connection; the client is disconnected.
        """

    def submit(self, request: PolicyRequest, tell: Callable[[Answer], object]) -> None:
        """Queue a request; `tell` is called once with its answer, on the model's thread. Raises
        RoboNeuronError.
        """

    def reply(self, answer: Answer, request: PolicyRequest) -> Reply:
        """The answer as a message. Raises RoboNeuronError for a client without numbers, which is
        disconnected.
        """


async def converse(connection: ServerConnection, conversation: Conversation) -> None:
    """Serve one client until it disconnects.

    Errors are sent as a text frame, as openpi does, and close only that connection; for an
    unexpected error the client receives no details.
    """
    peer = connection.remote_address
    open_tasks: set[asyncio.Task[None]] = set()
    previous: dict[str, float] = {}
    is_robot = False
    try:
        await send(connection, pack(conversation.first()))
        while True:
            data = await _received(connection, None if is_robot else IDLE_S)
            if data is None:
                await connection.close(CloseCode.GOING_AWAY, "idle")
                return
            request = await conversation.read(data)
            if not isinstance(request, PolicyRequest):
                await send(connection, pack(request))
                continue
            answering = _answer(connection, conversation, request, previous)
            is_robot = request.number is not None
            if not is_robot:  # openpi's clients wait for each answer
                await answering
                continue
            while len(open_tasks) >= _MOST_OPEN:
                await asyncio.wait(open_tasks, return_when=asyncio.FIRST_COMPLETED)
            task = asyncio.create_task(_guarded(connection, answering))
            open_tasks.add(task)
            task.add_done_callback(open_tasks.discard)
    except ConnectionClosed:
        pass
    except RoboNeuronError as error:
        log.warning("%s is dropped: %s", peer, error)
        await _fail(connection, told_of(error))
    except Exception:  # the border to one client: the others continue
        log.exception("%s is dropped.", peer)
        await _fail(connection, "InternalError: see the server's log.")
    finally:
        for task in open_tasks:
            task.cancel()


async def _received(connection: ServerConnection, idle_s: float | None) -> str | bytes | None:
    """The next message; None if there is none within `idle_s`."""
    # the second wait is for a message that is on its way through the front
    for limit_s in (idle_s, _GRACE_S):
        with suppress(TimeoutError):
            return await asyncio.wait_for(connection.recv(), limit_s)
    return None


async def _answer(
    connection: ServerConnection,
    conversation: Conversation,
    request: PolicyRequest,
    previous: dict[str, float],
) -> None:
    """Answer one request; `previous` is the timing of the one before, which openpi sends too."""
    began_s = time.monotonic()
    reply = await answered(conversation, request)
    reply["server_timing"] |= previous
    await send(connection, pack(reply))
    previous["prev_total_ms"] = (time.monotonic() - began_s) * 1e3


async def answered(conversation: Conversation, request: PolicyRequest) -> dict[str, Any]:
    """The answer to a request as a message, with the time that it took.

    Raises:
        RoboNeuronError: as `Conversation.reply`.
    """
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    told: asyncio.Future[Answer] = loop.create_future()

    def settle(answer: Answer) -> None:
        if not told.done():
            told.set_result(answer)

    def tell(answer: Answer) -> None:
        with suppress(RuntimeError):  # the server has ended: the answer has no receiver
            loop.call_soon_threadsafe(settle, answer)

    answer: Answer
    try:
        conversation.submit(request, tell)
        async with asyncio.timeout(request.left_s + _GRACE_S):
            answer = await told
    except TimeoutError:
        answer = NotReadyError("The model gave no answer before the deadline.")
    except RoboNeuronError as error:
        answer = error
    timing = {"infer_ms": (loop.time() - began_s) * 1e3}
    return {**conversation.reply(answer, request), "server_timing": timing}


async def _guarded(connection: ServerConnection, answering: Coroutine[None, None, None]) -> None:
    """Answer beside other requests of the connection; without an answer it ends."""
    try:
        await answering
    except ConnectionClosed:
        pass
    except Exception:  # the border to one client: the others continue
        log.exception("%s is dropped.", connection.remote_address)
        connection.transport.abort()


def told_of(error: RoboNeuronError) -> str:
    """Text of an error for the client, which is disconnected."""
    told = str(error) if isinstance(error, _TOLD) else "see the server's log."
    return f"{type(error).__name__}: {told}"


async def _fail(connection: ServerConnection, text: str) -> None:
    with suppress(ConnectionClosed):
        await send(connection, text)
        await connection.close(CloseCode.INTERNAL_ERROR, "see the text frame before")
