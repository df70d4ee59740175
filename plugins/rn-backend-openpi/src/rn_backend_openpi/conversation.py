"""One client's conversation with a served model: requests decoded, answers encoded."""

from __future__ import annotations

import asyncio
import logging
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from rn_backend_openpi import messages
from rn_backend_openpi.batching import Answer, Waiting
from rn_backend_openpi.listener import send
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import Value, pack, unpack
from roboneuron import (
    ActionChunk,
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    Observation,
    PluginError,
    RoboNeuronError,
    UngroundedError,
    UnsafeError,
    foreign,
)

if TYPE_CHECKING:
    from rn_backend_openpi.model_server import SharedModelServer

MOST_LEFT_S = 3600.0
ANSWER_S = 10.0
"""Time for an answer to a client that gives none."""
_MOST_HELD = 8
"""Number of chunk contexts kept for a robot: of the running chunk, and of answers in transit."""
_NUMBER_BITS = 62
"""Bits of the random number of a connection's first request."""
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


class Conversation:
    """One client's conversation.

    Args:
        server: the model's server.
    """

    def __init__(self, server: SharedModelServer) -> None:
        self._server = server
        self._session = secrets.randbits(_NUMBER_BITS)
        self._last = secrets.randbits(_NUMBER_BITS)
        self._held: OrderedDict[int, object] = OrderedDict()

    def expect(self, number: int) -> None:
        """Take that number for the next request's: others were answered elsewhere."""
        self._last = number - 1

    def first(self) -> Reply:
        """The server's first message."""
        return self._server.first(self._last)

    async def read(self, data: str | bytes) -> PolicyRequest | Reply:
        """Decode a request, or answer it at once; one at a time.

        Raises:
            RoboNeuronError: it is malformed, or of another connection; the client is disconnected.
        """
        if isinstance(data, str):
            raise InvalidInputError("A request is a binary frame of msgpack, this one is text.")
        request = foreign.table(unpack(data), "a request")
        own = foreign.table(request.get(RESERVED, {}), RESERVED)
        if "number" not in own:
            return await self._plain(request, own)
        found, clock_ns = (
            foreign.integer(foreign.field(own, name), name) for name in ("number", "clock_ns")
        )
        if found != self._last + 1:
            raise ForeignDataError(
                f"request {found} was replayed, lost or from another connection: "
                f"{self._last + 1} comes next"
            )
        self._last = found
        if "robot" in own:
            told = {**self._server.metadata(), **self._server.space_on(own["robot"])}
            return {RESERVED: {**told, "number": found, "clock_ns": clock_ns}}
        try:
            left_s = foreign.number(foreign.field(own, "left_s"), "left_s", 0.0, MOST_LEFT_S)
            observation = await self._observation(request)
        except ForeignDataError as error:
            refusal = InvalidInputError(f"The observation cannot be read: {error}.")
            return self._told(refusal, found, clock_ns)
        except RoboNeuronError as error:
            return self._told(error, found, clock_ns)
        return PolicyRequest(
            observation=observation, left_s=left_s, number=found, clock_ns=clock_ns
        )

    async def _plain(self, request: Document, own: Document) -> PolicyRequest | Reply:
        """Decode a request of a client of openpi's kind, which waits for each answer."""
        endpoint = request.get("endpoint", "infer")
        if endpoint == "reset":
            return {"status": "reset successful"}
        if endpoint != "infer":
            raise InvalidInputError(f"There is no endpoint {str(endpoint)[:40]!r}.")
        left_s = foreign.number(own.get("left_s", ANSWER_S), "left_s", 0.0)
        model = self._server.model
        if model.layout is None:
            observation = await self._observation(request)
        else:
            observation = model.layout.observation_of(
                request, needed=model.spec.cameras, has_state=model.spec.needs_state
            )
        return PolicyRequest(observation=observation, left_s=min(left_s, ANSWER_S))

    async def _observation(self, request: Document) -> Observation:
        if messages.has_coded_images(request):  # their decoding must not hold up other connections
            return await asyncio.to_thread(messages.to_observation, request, self._recall)
        return messages.to_observation(request, self._recall)

    def submit(self, request: PolicyRequest, tell: Callable[[Answer], object]) -> None:
        """Queue a request; `tell` is called once with its answer, on the model's thread. Raises
        RoboNeuronError.
        """

        def hold_and_tell(answer: Answer) -> None:
            # on the model's thread, so that a context exists before the robot can name it
            number = request.number
            if (
                number is not None
                and isinstance(answer, ActionChunk)
                and answer.context is not None
            ):
                self._held[number] = answer.context
                while len(self._held) > _MOST_HELD:
                    self._held.popitem(last=False)
            tell(answer)

        deadline_s = time.monotonic() + request.left_s
        self._server.submit(
            Waiting(
                observation=request.observation,
                deadline_s=deadline_s,
                tell=hold_and_tell,
                connection=self,
            )
        )

    def reply(self, answer: Answer, request: PolicyRequest) -> Reply:
        """The answer as a message. Raises RoboNeuronError for a client without numbers, which is
        disconnected.
        """
        if request.number is not None:
            return self._told(answer, request.number, request.clock_ns)
        self._server.statistics.note(answer)
        if isinstance(answer, RoboNeuronError):
            raise answer
        layout = self._server.model.layout
        if layout is None:
            return messages.from_answer(answer)
        return layout.reply_of(answer, request.observation)

    def _told(self, answer: Answer, found: int, clock_ns: int) -> Reply:
        """An answer with the number of its request."""
        self._server.statistics.note(answer)
        held = messages.HeldContext(self._session, found) if found in self._held else None
        try:
            told = messages.from_answer(answer, held)
        except (TypeError, ValueError, OverflowError) as error:
            refusal = PluginError(f"The answer of the shared model cannot be sent: {error}.")
            told = messages.from_answer(refusal)
        return {**told, RESERVED: {**told[RESERVED], "number": found, "clock_ns": clock_ns}}

    def _recall(self, named: messages.HeldContext) -> object:
        """A stored context; None for that of another connection."""
        return self._held.get(named.number) if named.session == self._session else None


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
            is_robot = request.number is not None
            if not is_robot:  # openpi's clients wait for each answer
                await _answer(connection, conversation, request, previous)
                continue
            while len(open_tasks) >= _MOST_OPEN:
                await asyncio.wait(open_tasks, return_when=asyncio.FIRST_COMPLETED)
            answering = _answer(connection, conversation, request, previous)
            open_tasks.add(task := asyncio.create_task(answering))
            task.add_done_callback(partial(_ended, connection, open_tasks))
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


def _ended(
    connection: ServerConnection, open_tasks: set[asyncio.Task[None]], task: asyncio.Task[None]
) -> None:
    """Forget a request that was answered beside others; without an answer the connection ends."""
    open_tasks.discard(task)
    error = None if task.cancelled() else task.exception()
    if error is not None and not isinstance(error, ConnectionClosed):
        log.error("%s is dropped.", connection.remote_address, exc_info=error)
        connection.transport.abort()


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


def told_of(error: RoboNeuronError) -> str:
    """Text of an error for the client, which is disconnected."""
    told = str(error) if isinstance(error, _TOLD) else "see the server's log."
    return f"{type(error).__name__}: {told}"


async def _fail(connection: ServerConnection, text: str) -> None:
    with suppress(ConnectionClosed):
        await send(connection, text)
        await connection.close(CloseCode.INTERNAL_ERROR, "see the text frame before")
