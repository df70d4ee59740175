"""The backend `shared`: a client of a model that several robots use."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_backend_openpi.messages import raise_told
from rn_backend_openpi.plugin import SHARED
from rn_backend_openpi.remote import ModelLink
from rn_backend_openpi.session import Welcome
from rn_backend_openpi.shared_options import SharedOptions
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
    """Implements `roboneuron.contract.Backend`."""

    def __init__(
        self, config: SharedOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        self._options = config
        self._link: ModelLink | None = None
        self._welcome: Welcome | None = None

    def load(self) -> None:
        """Connect to the model's server; on this machine, start it if it does not run.

        Raises:
            NotReadyError: it was not ready in time.
            RoboNeuronError: the error of its backend if it could not load the model.
        """
        if self._link is not None:
            raise StateError("Backend 'shared' is loaded already; close it first.")
        link = ModelLink(self._options)
        try:
            self._welcome = link.open()
        except BaseException:
            link.close()
            raise
        self._link = link

    def served_spec(self, profile: RobotProfile) -> tuple[BackendSpec, ControlSpace] | None:
        """Descriptor and control space of a model on another machine, requested from its server for
        this robot. None for a model on this machine.

        Raises:
            NotReadyError: the server does not answer.
            RoboNeuronError: the error of its backend if this robot cannot use the model.
            ConfigurationError: the server gives no control space.
        """
        if self._link is None or self._options.address is None:
            return None
        told = self._link.describe(profile)
        if told.refusal is not None:
            raise_told(told.refusal)
        if told.space is None:
            raise ConfigurationError(
                f"The server {self._options.address} does not give the control space of its model.",
                hint="Install the same release of rn-backend-openpi on that machine.",
            )
        served = replace(
            SHARED,
            cameras=told.cameras,
            optional_cameras=told.optional_cameras,
            action_space=ActionSpace(horizon=told.horizon, step_s=told.step_s),
            conditions_on_rows=told.continues,
            max_committed_rows=told.most_committed,
            takes_predicted_state=told.takes_predicted_state,
        )
        return served, told.space

    def predict(self, observation: Observation) -> ActionChunk:
        """Request a chunk from the shared model.

        Raises:
            NotReadyError: no answer in time, or the server is gone; the next observation may
                succeed.
            InvalidInputError: a camera that the model needs, or the state, is missing.
            UnsafeError: the state is not finite.
            RoboNeuronError: the model's error for this observation.
        """
        if self._link is None or self._welcome is None:
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
        return self._link.ask(observation, deadline_s)

    def reset(self) -> None:
        """Nothing to do: only models without a history can be shared."""

    def close(self) -> None:
        """Disconnect; idempotent."""
        link, self._link = self._link, None
        if link is not None:
            link.close()


if TYPE_CHECKING:
    _: type[Backend] = SharedBackend
