"""The backend `shared`: has observations answered by a model that several robots use."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_backend_shared import wire
from rn_backend_shared.links import Links
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.plugin import BACKEND
from rn_backend_shared.remote import RemoteLink
from rn_backend_shared.session import Welcome
from roboneuron import (
    ActionChunk,
    ActionSpace,
    Backend,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    Observation,
    RobotProfile,
    StateError,
)


class SharedBackend:
    """Follows `roboneuron.contract.Backend`."""

    def __init__(
        self, config: SharedOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        self._options = config
        self._links: Links | RemoteLink | None = None
        self._welcome: Welcome | None = None

    def load(self) -> None:
        """Reach the server of the model; on this machine, start it when there is none.

        Raises:
            NotReadyError: it was not ready in time.
            RoboNeuronError: why it could not load the model, as that backend says it.
        """
        if self._links is not None:
            raise StateError("Backend 'shared' is loaded already; close it first.")
        options = self._options
        links = Links(options) if options.address is None else RemoteLink(options)
        try:
            self._welcome = links.open()
        except BaseException:
            links.close()
            raise
        self._links = links

    def served_spec(self, profile: RobotProfile) -> tuple[BackendSpec, ControlSpace] | None:
        """What the server of another machine tells of its model to this robot: its needs and
        chunks, as a descriptor, and the space of its rows. None for a model of this machine.

        Raises:
            NotReadyError: it does not answer.
            RoboNeuronError: why this robot cannot use the model, as its backend says it.
            ConfigurationError: it tells no space.
        """
        if not isinstance(self._links, RemoteLink):
            return None
        told = self._links.describe(profile)
        if told.refusal is not None:
            wire.to_answer(told.refusal)
        if told.space is None:
            raise ConfigurationError(
                f"The server {self._options.address} does not say in which space its model acts.",
                hint="Install the same release of rn-backend-shared there.",
            )
        served = replace(
            BACKEND,
            cameras=told.cameras,
            optional_cameras=told.optional_cameras,
            action_space=ActionSpace(horizon=told.horizon, step_s=told.step_s),
            conditions_on_rows=told.continues,
            max_committed_rows=told.most_committed,
            takes_predicted_state=told.takes_predicted_state,
        )
        return served, told.space

    def predict(self, observation: Observation) -> ActionChunk:
        """What the shared model answers.

        Raises:
            NotReadyError: no answer in time, or the server is gone; the next observation may be
                answered again.
            InvalidInputError: a camera that the model needs, or the state, is absent.
            UnsafeError: the state is not finite.
            RoboNeuronError: what the model says of this observation.
        """
        if self._links is None or self._welcome is None:
            raise StateError("Backend 'shared' is not loaded; call load first.")
        needed, frames = ("primary", *self._welcome.cameras), observation.frames
        lacking = [role for role in needed if role not in frames]
        if lacking or observation.joints is None:
            raise InvalidInputError(
                f"The observation has no {f'image of {lacking[0]!r}' if lacking else 'state'}."
            )
        used = {*needed, *self._welcome.optional_cameras}
        if not frames.keys() <= used:
            seen = {role: frame for role, frame in frames.items() if role in used}
            observation = replace(observation, frames=seen)
        deadline_s = time.monotonic() + self._options.timeout_s
        return self._links.ask(observation, deadline_s)

    def reset(self) -> None:
        """Nothing is remembered between observations: only such models can be shared."""

    def close(self) -> None:
        """Hang up; idempotent."""
        links, self._links = self._links, None
        if links is not None:
            links.close()


if TYPE_CHECKING:
    _: type[Backend] = SharedBackend
