"""One client's conversation with the server of a model: requests decoded, answers encoded."""

from __future__ import annotations

import asyncio
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING

from rn_backend_openpi import messages
from rn_backend_openpi.batching import Answer, Waiting
from rn_backend_openpi.conversations import PolicyRequest, Reply
from rn_backend_openpi.fields import field, integer, number, table
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.wire import unpack
from roboneuron import (
    ActionChunk,
    ForeignDataError,
    InvalidInputError,
    Observation,
    PluginError,
    RoboNeuronError,
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


class ModelConversation:
    """One robot's conversation; see `Conversation`.

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
        return self._server.first(self._last)

    async def read(self, data: str | bytes) -> PolicyRequest | Reply:
        if isinstance(data, str):
            raise InvalidInputError("A request is a binary frame of msgpack, this one is text.")
        request = table(unpack(data), "a request")
        own = table(request.get(RESERVED, {}), RESERVED)
        if "number" not in own:
            return await self._plain(request, own)
        found, clock_ns = (integer(field(own, name), name) for name in ("number", "clock_ns"))
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
            left_s = number(field(own, "left_s"), "left_s", 0.0, MOST_LEFT_S)
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
        left_s = number(own.get("left_s", ANSWER_S), "left_s", 0.0)
        model = self._server.model
        if model.layout is None:
            observation = await self._observation(request)
        else:
            observation = model.layout.observation_of(
                request, needed=model.spec.cameras, has_state=model.spec.needs_state
            )
            observation = self._server.cropped(observation, {})
        return PolicyRequest(observation=observation, left_s=min(left_s, ANSWER_S))

    async def _observation(self, request: Document) -> Observation:
        if messages.has_coded_images(request):  # their decoding must not hold up other connections
            observation = await asyncio.to_thread(messages.to_observation, request, self._recall)
        else:
            observation = messages.to_observation(request, self._recall)
        return self._server.cropped(observation, request)

    def submit(self, request: PolicyRequest, tell: Callable[[Answer], object]) -> None:
        def hold_and_tell(answer: Answer) -> None:
            # on the model's thread, so that a context exists before the robot can name it
            if request.number is not None and isinstance(answer, ActionChunk):
                self._hold(answer, request.number)
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
        if request.number is not None:
            return self._told(answer, request.number, request.clock_ns)
        self._server.note(answer)
        if isinstance(answer, RoboNeuronError):
            raise answer
        layout = self._server.model.layout
        if layout is None:
            return messages.from_answer(answer)
        return layout.reply_of(answer, request.observation)

    def _told(self, answer: Answer, found: int, clock_ns: int) -> Reply:
        """An answer with the number of its request."""
        self._server.note(answer)
        held = messages.HeldContext(self._session, found) if found in self._held else None
        try:
            told = messages.from_answer(answer, held)
        except (TypeError, ValueError, OverflowError) as error:
            refusal = PluginError(f"The answer of the shared model cannot be sent: {error}.")
            told = messages.from_answer(refusal)
        return {**told, RESERVED: {**told[RESERVED], "number": found, "clock_ns": clock_ns}}

    def _hold(self, chunk: ActionChunk, found: int) -> None:
        """Store the context of a chunk."""
        if chunk.context is None:
            return
        self._held[found] = chunk.context
        while len(self._held) > _MOST_HELD:
            self._held.popitem(last=False)

    def _recall(self, named: messages.HeldContext) -> object:
        """A stored context; None for that of another connection."""
        return self._held.get(named.number) if named.session == self._session else None
