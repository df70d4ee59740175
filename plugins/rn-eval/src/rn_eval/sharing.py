"""One policy shared by many workers: concurrent requests are answered by one forward pass."""

from __future__ import annotations

import asyncio
from importlib import import_module
from typing import Any, NamedTuple, cast

from rn_eval.plan import EvalPlan
from rn_eval.policy import BatchBackend, load_backend
from rn_eval.pools import Located
from roboneuron import ActionChunk, Backend, ConfigurationError, Observation, PluginError
from roboneuron.command import discover

MOST_IN_BATCH = 32
_GATHER_S = 0.002
"""Time after the first request of a batch in which others may join: simulators that were answered
together also ask together.
"""


class SharedRequest(NamedTuple):
    """Request of one worker."""

    preset: str
    observation: Observation
    answer: asyncio.Future[ActionChunk]


class PolicyActor(Located):
    """Holds a backend; an asynchronous Ray actor. Observations that arrive during a forward pass
    form the next batch. Where Ray starts it again, the next request loads the backend.
    """

    def __init__(self, plan: str) -> None:
        self._plan = EvalPlan.model_validate_json(plan)
        self._registry = discover()
        self._backend: Backend | None = None
        self._preset = ""
        self._waiting: list[SharedRequest] = []
        self._arrived = asyncio.Event()
        self._using = asyncio.Lock()
        self._server: asyncio.Task[None] | None = None
        self._sizes: list[int] = []

    async def open(self, preset: str) -> None:
        """Load the backend with a preset, unless it is loaded.

        Raises:
            ConfigurationError: it has no `predict_batch`.
        """
        async with self._using:
            self._load(preset)

    async def predict(self, preset: str, observation: Observation) -> ActionChunk:
        """Predict in a batch with concurrent requests. Raises what the backend raises."""
        if self._server is None:
            self._server = asyncio.get_running_loop().create_task(self._serve())
        answer: asyncio.Future[ActionChunk] = asyncio.get_running_loop().create_future()
        self._waiting.append(SharedRequest(preset, observation, answer))
        self._arrived.set()
        return await answer

    async def sizes(self) -> list[int]:
        """Number of requests in each batch so far."""
        return self._sizes

    def _load(self, preset: str) -> None:
        if self._backend is None or self._preset != preset:
            if self._backend is not None:
                self._backend.close()
            self._backend, self._preset = load_backend(self._plan, self._registry, preset), preset
        if not isinstance(self._backend, BatchBackend):
            raise ConfigurationError(
                f"The backend {self._plan.backend!r} offers no predict_batch, so workers cannot "
                "share it.",
                hint="Leave --policy-actors out: each worker then loads its own.",
            )

    async def _serve(self) -> None:
        while True:
            await self._arrived.wait()
            await asyncio.sleep(_GATHER_S)
            # Workers that end the last episodes of one preset ask at the same time as those that
            # began the next.
            preset = self._waiting[0].preset
            batch = [request for request in self._waiting if request.preset == preset][
                :MOST_IN_BATCH
            ]
            self._waiting = [
                request for request in self._waiting if all(request is not one for one in batch)
            ]
            if not self._waiting:
                self._arrived.clear()
            async with self._using:
                await asyncio.to_thread(self._forward, batch, asyncio.get_running_loop())

    def _forward(self, batch: list[SharedRequest], loop: asyncio.AbstractEventLoop) -> None:
        try:
            self._load(batch[0].preset)
            backend = cast("BatchBackend", self._backend)
            chunks = list(backend.predict_batch([request.observation for request in batch]))
            if len(chunks) != len(batch):
                raise PluginError(
                    f"predict_batch answered {len(chunks)} of {len(batch)} observations."
                )
        except Exception as error:
            if len(batch) == 1:
                loop.call_soon_threadsafe(_fail, batch[0].answer, error)
            else:  # one bad observation must not fail the others, so each is predicted alone
                for request in batch:
                    self._forward([request], loop)
            return
        self._sizes.append(len(batch))
        for request, chunk in zip(batch, chunks, strict=True):
            loop.call_soon_threadsafe(_resolve, request.answer, chunk)


def _resolve(answer: asyncio.Future[ActionChunk], chunk: ActionChunk) -> None:
    if not answer.done():
        answer.set_result(chunk)


def _fail(answer: asyncio.Future[ActionChunk], error: Exception) -> None:
    if not answer.done():
        answer.set_exception(error)


class SharedPolicy:
    """A worker's proxy of a `PolicyActor`; follows the protocol `EpisodePolicy`."""

    def __init__(self, actor: Any, preset: str) -> None:
        self._ray: Any = import_module("ray")  # heavy
        self._actor, self._preset = actor, preset
        self._get(actor.open.remote(preset))

    def predict(self, observation: Observation) -> ActionChunk:
        """Send the observation to the actor and wait for the chunk."""
        chunk: ActionChunk = self._get(self._actor.predict.remote(self._preset, observation))
        return chunk

    def reset(self) -> None:
        """Do nothing; there is no state between predictions."""

    def close(self) -> None:
        """Do nothing; other workers use the actor."""

    def _get(self, reference: object) -> Any:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            raise error.as_instanceof_cause() from None
