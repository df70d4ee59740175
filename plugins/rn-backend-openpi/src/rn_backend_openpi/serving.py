"""Serving of a backend: requests in, answers out, in batches and by deadline."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol, cast

import numpy as np

from rn_backend_openpi import metadata
from rn_backend_openpi.batching import Answer, Batcher, Waiting
from rn_backend_openpi.conversations import PolicyRequest, Reply
from rn_backend_openpi.fields import number, table
from rn_backend_openpi.interface import layout_of
from rn_backend_openpi.layout import Layout
from rn_backend_openpi.messages import RESERVED
from rn_backend_openpi.metadata import STEP
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.options import PLAIN, OpenpiOptions
from rn_backend_openpi.plugin import BACKEND
from rn_backend_openpi.shared_options import SharedOptions
from rn_backend_openpi.wire import Value, unpack
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    InvalidInputError,
    Observation,
    PluginError,
    RoboNeuronError,
    RobotProfile,
    RuntimeSpec,
)
from roboneuron.command import Config, Registry, load_profile, loading

_RATE_SHARE = 0.02
"""Relative tolerance between a chunk's period and the profile's: rates are given in whole Hz."""


class Model(Protocol):
    """The served model; see `SharedModel`."""

    @property
    def most(self) -> int:
        """Largest useful batch of observations."""

    def load(self) -> None:
        """Load."""

    def answer(self, observations: Sequence[Observation]) -> Sequence[Answer]:
        """Return one answer for each observation."""

    def close(self) -> None:
        """Release what was loaded."""


class ServedPolicy:
    """A backend with its interface.

    Args:
        model: not loaded yet.
        spec: descriptor of its backend.
        layout: interface of requests and answers.
        space: control space that the backend declares.
        options: options of the server.
    """

    def __init__(
        self,
        model: Model,
        spec: BackendSpec,
        layout: Layout,
        space: ControlSpace,
        options: OpenpiOptions,
    ) -> None:
        self._model, self._spec, self._layout, self._space = model, spec, layout, space
        self._options, self._dialect = options.server, options.dialect
        self._batcher: Batcher | None = None
        self.clients: Callable[[], int] = lambda: 1
        """Number of clients, which limits the batches."""

    def load(self) -> None:
        """Load the model, and start answering. Raises RoboNeuronError as `Backend.load`."""
        try:
            self._model.load()
        except ConfigurationError as error:
            hint = error.hint.replace("[plugins.shared]", "[plugins.openpi.server]")
            raise ConfigurationError(error.message, hint=hint) from error
        options = self._options
        self._batcher = Batcher(
            self._model.answer,
            most=min(self._model.most, options.most),
            waiting=options.waiting,
            linger_s=options.linger_s,
            clients=lambda: self.clients(),
        )
        self._batcher.start()

    def close(self) -> None:
        """Stop answering and release the model; idempotent."""
        batcher, self._batcher = self._batcher, None
        if batcher is not None:
            batcher.close()
            self._model.close()

    @property
    def summary(self) -> str:
        """Names of the backend, the profile and the control space."""
        layout = self._layout
        return f"backend {self._spec.name}, profile {layout.name}, {layout.rows.space.kind}"

    def first(self) -> dict[str, Value]:
        """The server's first message to a client."""
        if self._dialect == "roboarena":
            return metadata.describe_arena(self._layout)
        return metadata.describe(
            self._layout,
            backend=self._spec.name,
            needed=self._spec.cameras,
            horizon=self._spec.action_space.horizon,
        )

    async def read(self, data: str | bytes) -> PolicyRequest | Reply:
        """Decode a request; one that begins an episode is answered at once.

        Raises:
            InvalidInputError: it is malformed; the message names the entry.
            UnsafeError: a value of the state is not finite.
        """
        if isinstance(data, str):
            raise InvalidInputError("A request is a binary frame of msgpack, this one is text.")
        request = unpack(data)
        if not isinstance(request, dict):
            raise InvalidInputError("A request is a map, this one is an array.")
        endpoint = request.get("endpoint", "infer")
        if endpoint == "reset":
            return {"status": "reset successful"}
        if endpoint != "infer":
            raise InvalidInputError(f"There is no endpoint {str(endpoint)[:40]!r}.")
        observation = self._layout.observation_of(
            request, needed=self._spec.cameras, has_state=self._spec.needs_state
        )
        most_s = self._options.answer_timeout_s
        own = table(request.get(RESERVED, {}), RESERVED)
        left_s = number(own.get("left_s", most_s), "left_s", 0.0)
        return PolicyRequest(observation=observation, left_s=min(left_s, most_s))

    def submit(self, question: PolicyRequest, tell: Callable[[Answer], object]) -> None:
        """Queue a request; `tell` is called once with its answer, on the model's thread.

        Args:
            question: decoded request.
            tell: callback for the answer.

        Raises:
            NotReadyError: the queue is full.
            PluginError: the model is not loaded.
        """
        if self._batcher is None:
            raise PluginError("The served model is not loaded.")
        deadline_s = time.monotonic() + question.left_s
        self._batcher.submit(
            Waiting(
                observation=question.observation,
                deadline_s=deadline_s,
                tell=tell,
            )
        )

    def reply(self, answer: Answer, question: PolicyRequest) -> dict[str, Value]:
        """The answer as a message.

        Raises:
            RoboNeuronError: the backend's error for this observation; or the chunk's space or
                period differs from the declared one.
        """
        if isinstance(answer, RoboNeuronError):
            raise answer
        rows = self._layout.rows
        self._check(answer)
        served = rows.from_contract(np.asarray(answer.actions), question.observation)
        model_ms = answer.metrics.get("shared.model_ms", 0.0)
        return {
            "actions": served.astype(self._options.precision),
            STEP: answer.step_s,
            "policy_timing": {"infer_ms": float(model_ms)},
        }

    def _check(self, chunk: ActionChunk) -> None:
        if chunk.space != self._space:
            raise PluginError(
                f"The backend {self._spec.name!r} answered in {chunk.space.label!r}, it declares "
                f"{self._space.label!r}."
            )
        step_s = self._layout.rows.step_s
        if step_s and abs(chunk.step_s / step_s - 1.0) > _RATE_SHARE:
            raise PluginError(
                f"The backend {self._spec.name!r} answered with rows every {chunk.step_s:g} s, the "
                f"profile {self._layout.name!r} has one every {step_s:g} s."
            )


def make_policy(config: Config, registry: Registry, options: OpenpiOptions) -> ServedPolicy:
    """Create the policy that a configuration names, without loading it.

    Args:
        config: its [robot], [inference] and options of plugins are read.
        registry: installed plugins.
        options: those of [plugins.openpi].

    Raises:
        ConfigurationError: no backend is named, or it does not match the profile; names both sides.
    """
    inference = config.inference
    if inference is None:
        raise ConfigurationError(
            "The configuration has no [inference]: there is nothing to serve.",
            hint='Add [inference] with backend = "...".',
        )
    if inference.backend == BACKEND.name:
        raise ConfigurationError(
            "The backend 'openpi' is itself a client of a server; it cannot be served.",
            hint="Name the backend that holds the model in [inference].",
        )
    spec = registry.get(BackendSpec, inference.backend)
    own = dict(config.options(spec.name))
    if inference.checkpoint is not None:
        own["checkpoint"] = inference.checkpoint
    space = _declared(spec, own, load_profile(registry, config.robot.name))
    if options.profile is None:
        options = options.model_copy(update={"profile": PLAIN})
    is_told = options.model_fields_set & {"space", "rate_hz", "joints", "arms"}
    layout = _for_backend(layout_of(options, None if is_told else space), spec, space)
    server = options.server
    runtime = inference.runtime or spec.default_runtime
    shared = SharedOptions(
        backend=spec.name,
        checkpoint=inference.checkpoint,
        options=dict(config.options(spec.name)),
        runtime=runtime or None,
        runtime_options=_options(registry, config, RuntimeSpec, runtime),
        acceleration=inference.acceleration,
        acceleration_options=dict(config.options(inference.acceleration or "")),
        stateless=server.stateless,
        most=server.most,
        waiting=server.waiting,
        linger_s=server.linger_s,
    )
    return ServedPolicy(SharedModel(shared), spec, layout, space, options)


def _options(
    registry: Registry, config: Config, of: type[RuntimeSpec], name: str
) -> dict[str, object]:
    """Options of an installed part. Raises ConfigurationError if it is not installed."""
    return dict(config.options(registry.get(of, name).name)) if name else {}


def _declared(
    spec: BackendSpec, options: Mapping[str, object], profile: RobotProfile
) -> ControlSpace:
    if spec.space is None:
        return EE_DELTA
    declare = cast(
        "Callable[[Mapping[str, object], RobotProfile], ControlSpace | None]",
        loading.load_attribute(spec.space, f"`space` of {spec.name!r}"),
    )
    declared = declare(options, profile)
    if declared is None:
        raise ConfigurationError(
            f"Only the server of its model knows the control space of backend {spec.name!r}.",
            hint=f"Set `space` in [plugins.{spec.name}].",
        )
    return declared


def _for_backend(layout: Layout, spec: BackendSpec, space: ControlSpace) -> Layout:
    """The layout with the cameras that the backend reads.

    Raises:
        ConfigurationError: a camera has no key, or the profile's control space differs from the
            backend's.
    """
    lacking = [role for role in spec.cameras if role not in layout.image_keys]
    if lacking:
        raise ConfigurationError(
            f"The backend {spec.name!r} needs the camera {lacking[0]!r}; profile {layout.name!r} "
            f"has keys for {', '.join(layout.image_keys)}.",
            hint="Add it to image_keys of [plugins.openpi].",
        )
    rows = layout.rows.space
    is_same = (rows.kind, rows.channels) == (space.kind, space.channels)
    if not is_same or (space.rate_hz and rows.rate_hz != space.rate_hz):
        raise ConfigurationError(
            f"The backend {spec.name!r} answers in {space.label!r}, profile {layout.name!r} is for "
            f"{rows.label!r}.",
            hint="Choose another profile in [plugins.openpi]; 'roboneuron' fits every backend.",
        )
    roles = (*spec.cameras, *spec.optional_cameras)
    keys = {role: key for role, key in layout.image_keys.items() if role in roles}
    optional = frozenset(keys) - frozenset(spec.cameras)
    return replace(layout, image_keys=keys, optional_roles=optional)
