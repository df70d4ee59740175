"""The backend `shared`: has observations answered by a model that several robots use."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rn_backend_shared import wire
from rn_backend_shared.links import Links
from rn_backend_shared.options import SharedOptions
from roboneuron import ActionChunk, Backend, InvalidInputError, Observation, PluginError, StateError


class SharedBackend:
    """Follows `roboneuron.contract.Backend`."""

    def __init__(
        self, config: SharedOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        self._options = config
        self._links: Links | None = None
        self._cameras: list[str] = []

    def load(self) -> None:
        """Reach the server of the model, or start it.

        Raises:
            NotReadyError: it was not ready in time.
            RoboNeuronError: why it could not load the model, as that backend says it.
        """
        if self._links is not None:
            raise StateError("Backend 'shared' is loaded already; close it first.")
        links = Links(self._options)
        try:
            self._cameras = links.open()
        except BaseException:
            links.close()
            raise
        self._links = links

    def predict(self, observation: Observation) -> ActionChunk:
        """What the shared model answers.

        Raises:
            NotReadyError: no answer in time, or the server is gone; the next observation may be
                answered again.
            InvalidInputError: a camera that the model needs, or the state, is absent.
            RoboNeuronError: what the model says of this observation.
        """
        if self._links is None:
            raise StateError("Backend 'shared' is not loaded; call load first.")
        lacking = [role for role in ("primary", *self._cameras) if role not in observation.frames]
        if lacking or observation.joints is None:
            raise InvalidInputError(
                f"The observation has no {f'image of {lacking[0]!r}' if lacking else 'state'}."
            )
        began_s = time.monotonic()
        told = self._links.ask(
            wire.from_observation(observation), began_s + self._options.timeout_s
        )
        try:
            chunk = wire.to_answer(told)
        except (KeyError, TypeError, ValueError) as error:
            raise PluginError(
                f"The server of the shared model answered what is no chunk: {error!r}."
            ) from error
        metrics = {**chunk.metrics, "shared.round_trip_ms": (time.monotonic() - began_s) * 1e3}
        return ActionChunk(
            actions=chunk.actions,
            step_s=chunk.step_s,
            metrics=metrics,
            note=chunk.note,
            space=chunk.space,
        )

    def reset(self) -> None:
        """Nothing is remembered between observations: only such models can be shared."""

    def close(self) -> None:
        """Hang up; idempotent."""
        links, self._links = self._links, None
        if links is not None:
            links.close()


if TYPE_CHECKING:
    _: type[Backend] = SharedBackend
