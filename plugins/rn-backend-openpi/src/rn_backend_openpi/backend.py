"""The backends `openpi` and `shared`: a client of a policy that is served elsewhere."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_backend_openpi.interface_options import PROFILES
from rn_backend_openpi.messages import raise_told
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.plugin import BACKEND, SHARED
from roboneuron import (
    ActionChunk,
    ActionSpace,
    Backend,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    Observation,
    RobotProfile,
    StateError,
    UngroundedError,
)

if TYPE_CHECKING:
    from rn_backend_openpi.client import PolicyClient
    from rn_backend_openpi.coding import Coder
    from rn_backend_openpi.description import ServerDescription
    from rn_backend_openpi.profile_policy import ProfilePolicy


class PolicyBackend:
    """Implements `roboneuron.contract.Backend`; the constructor has no side effects.

    With a profile it speaks with any server of openpi's websocket, in that profile's terms. Without
    one the server is RoboNeuron's, and is asked for everything.
    """

    spec = SHARED

    def __init__(
        self, config: PolicyOptions, *, runtime: object = None, acceleration: object = None
    ) -> None:
        if runtime is not None or acceleration is not None:
            raise ConfigurationError(
                "A policy that is served elsewhere takes no runtime and no acceleration.",
                hint="Name them where the model is: in `runtime` of [plugins.shared], or on its "
                "server.",
            )
        self._options = config
        self._client: PolicyClient | None = None
        self._description: ServerDescription
        self._policy: ProfilePolicy | None = None
        self._coder: Coder

    def load(self) -> None:
        """Connect to the server; on this machine, start it if it does not run. Compare its
        description with the options, and with a profile request one chunk.

        Raises:
            ConfigurationError: an option does not fit, the key is refused, or the server's
                description or answer do not fit.
            NotReadyError: the server cannot be reached, fails, or was not ready in time.
            UnsafeError: the server's model produces non-finite values.
            RoboNeuronError: the error of its backend if it could not load the model.
            StateError: the backend is already loaded.
        """
        if self._client is not None:
            raise StateError("The backend is loaded already.", hint="Call close() first.")
        from rn_backend_openpi.client import PolicyClient  # heavy
        from rn_backend_openpi.coding import Coder
        from rn_backend_openpi.profile_policy import ProfilePolicy

        options = self._options
        self._policy = None if options.profile is None else ProfilePolicy(options)
        with ExitStack() as undo:
            client = PolicyClient(options)
            undo.callback(client.close)
            session = client.open()
            told = self._description = session.description
            if self._policy is not None:
                self._policy.agree(told)
                self._policy.warm_up(client.exchange)
            elif not told.is_ours:
                raise ConfigurationError(
                    f"The server at {options.url or options.address} is none of `roboneuron "
                    "policy serve`; what goes over the wire is never guessed.",
                    hint=f"Set the option profile; choose one of {PROFILES}.",
                )
            self._coder = Coder(options, told.image_sizes, session.base_s)
            undo.pop_all()
        self._client = client

    def served_spec(self, profile: RobotProfile) -> tuple[BackendSpec, ControlSpace] | None:
        """Descriptor and control space of a model on another machine, requested from RoboNeuron's
        server for this robot. None for a model on this machine, or with a profile.

        Raises:
            NotReadyError: the server does not answer.
            RoboNeuronError: the error of its backend if this robot cannot use the model.
            ConfigurationError: the server gives no control space.
        """
        if self._client is None or self._options.is_local or self._policy is not None:
            return None
        told = self._client.describe(profile)
        if told.refusal is not None:
            raise_told(told.refusal)
        if told.space is None:
            raise ConfigurationError(
                "The server does not give the control space of its model.",
                hint="Install the same release of rn-backend-openpi on that machine.",
            )
        served = replace(
            self.spec,
            cameras=told.cameras,
            optional_cameras=told.optional_cameras,
            action_space=ActionSpace(horizon=told.horizon, step_s=told.step_s),
            conditions_on_rows=told.continues,
            max_committed_rows=told.most_committed,
            takes_predicted_state=told.takes_predicted_state,
        )
        return served, told.space

    def predict(self, observation: Observation) -> ActionChunk:
        """Request a chunk.

        Raises:
            NotReadyError: no answer in time, or the server is gone; the next observation may
                succeed.
            UngroundedError: a camera or a part of the state is missing.
            UnsafeError: the state or the answer is not finite.
            ConfigurationError: the answer does not follow the protocol or the profile.
            RoboNeuronError: the model's error for this observation.
            StateError: `load` was not called.
        """
        client = self._client
        if client is None:
            raise StateError("The backend is not loaded.", hint="Call load() first.")
        deadline_s = time.monotonic() + self._options.timeout_s
        if self._policy is not None:
            chunk = self._policy.ask(observation, client.exchange, deadline_s)
        else:
            chunk = self._coder.ask(self._used(observation), client.ask, deadline_s)
        metrics = {**chunk.metrics, "connections": float(client.connections)}
        return replace(chunk, metrics=metrics, note=client.warning or chunk.note)

    def _used(self, observation: Observation) -> Observation:
        """The observation with the cameras that the model uses. Raises UngroundedError."""
        needed, frames = ("primary", *self._description.cameras), observation.frames
        lacking = [role for role in needed if role not in frames]
        if lacking or observation.joints is None:
            raise UngroundedError(
                f"The observation has no {f'image of {lacking[0]!r}' if lacking else 'state'}, "
                "which the served model needs.",
                hint="Is that camera or the robot running?",
            )
        used = {*needed, *self._description.optional_cameras}
        if frames.keys() <= used:
            return observation
        seen = {role: frame for role, frame in frames.items() if role in used}
        return replace(observation, frames=seen)

    def reset(self) -> None:
        """Start a new episode; only a server with episodes is told."""
        if self._policy is not None:
            self._policy.begin_episode()

    def close(self) -> None:
        """Disconnect; idempotent."""
        client, self._client = self._client, None
        if client is not None:
            client.close()


class OpenpiBackend(PolicyBackend):
    """The same under the name `openpi`."""

    spec = BACKEND


if TYPE_CHECKING:
    _: type[Backend] = PolicyBackend
