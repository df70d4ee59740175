"""The runtime `sglang`: forwards requests to a server that holds the model."""

from __future__ import annotations

import logging
import os
import secrets
import ssl
import threading
import time
from typing import TYPE_CHECKING

from rn_runtime_sglang.config import SglangRuntimeConfig
from rn_runtime_sglang.connection import Access
from rn_runtime_sglang.fleet import ServerPool
from rn_runtime_sglang.identity import Expectation
from rn_runtime_sglang.plugin import FAMILIES
from rn_runtime_sglang.process import ManagedServer
from rn_runtime_sglang.server import SglangServer
from rn_runtime_sglang.wire import encode_body
from rn_vla.decoding import LlamaAcceleration, PolicyModel, TokenReply, TokenRequest, TokenRuntime
from roboneuron import ConfigurationError, InvalidInputError, NotReadyError, StateError

log = logging.getLogger(__name__)
_WARM_PROMPT_TOKENS = 16
_WARM_S = 120.0
"""Time limit of an engine's first request, which may compile kernels."""


class SglangRuntime:
    """Implements `rn_vla.decoding.TokenRuntime`; `run` is called from one thread, `abort` from
    any.
    """

    def __init__(self, config: SglangRuntimeConfig) -> None:
        self._config = config
        self._model: PolicyModel | None = None
        self._managed: ManagedServer | None = None
        self._fleet: ServerPool | None = None
        self._aborted = threading.Event()

    def load(self, model: PolicyModel, acceleration: LlamaAcceleration | None = None) -> None:
        """Launch or connect to the servers, check their models, and run one example.

        Raises:
            InvalidInputError: not a model of a supported family.
            MissingDependencyError: SGLang is not installed for `python`, or a server runs another
                release.
            CheckpointError: a server serves another model.
            ConfigurationError: an option does not fit, or the API key is refused.
            NotReadyError: no server is ready in time, or the launched one ended; the message has
                its last lines.
        """
        if not isinstance(model, PolicyModel) or model.family not in FAMILIES:
            raise InvalidInputError(
                f"Runtime 'sglang' got {model!r}, expected a PolicyModel of {', '.join(FAMILIES)}."
            )
        if acceleration is not None:
            raise ConfigurationError(
                "Runtime 'sglang' executes the model in another process and takes no acceleration.",
                hint="Leave the acceleration out, or choose the runtime torch.",
            )
        if self._fleet is not None:
            raise StateError("Runtime 'sglang' already holds a model; close it first.")
        try:
            self._load(model)
        except BaseException:
            self.close()
            raise

    def _load(self, model: PolicyModel) -> None:
        config = self._config
        expectation = Expectation.of(model.checkpoint)
        accesses = self._launch(model) if config.python is not None else self._remote()
        fleet = self._fleet = ServerPool(
            [SglangServer(access, expectation, config.poll_s) for access in accesses]
        )
        try:
            fleet.start(config.start_timeout_s, self._check_process)
        except NotReadyError as error:
            if self._managed is not None and not self._managed.failure():
                error.hint = self._managed.last_lines()
            raise
        example = model.example(min(_WARM_PROMPT_TOKENS, model.max_prompt_tokens))
        assert isinstance(example, TokenRequest)
        self._answer(fleet, model, example, time.monotonic() + min(_WARM_S, config.start_timeout_s))
        self._model = model

    def _launch(self, model: PolicyModel) -> list[Access]:
        # must not begin with "-", which an argument parser takes for an option
        key = secrets.token_hex(24)
        self._managed = ManagedServer(self._config, model.checkpoint.resolve(), key)
        url = self._managed.start()
        return [Access(url=url, key=key, connect_timeout_s=self._config.connect_timeout_s)]

    def _remote(self) -> list[Access]:
        config = self._config
        key = ""
        if config.key_variable is not None:
            key = os.environ.get(config.key_variable, "")
            if not key:
                raise ConfigurationError(
                    f"The environment variable {config.key_variable} holds no API key.",
                    hint="Set it where the inference module starts, or leave `key_variable` out.",
                )
        try:
            tls = ssl.create_default_context(
                cafile=None if config.ca_file is None else str(config.ca_file)
            )
        except OSError as error:
            raise ConfigurationError(f"ca_file {config.ca_file} cannot be used: {error}") from error
        accesses = [
            Access(
                url=url.rstrip("/"), key=key, connect_timeout_s=config.connect_timeout_s, tls=tls
            )
            for url in config.urls
        ]
        for access in accesses:
            if access.is_open_to_others:
                log.warning(
                    "%s is not encrypted: images, instructions%s and the actions that move the "
                    "robot can be read and "
                    "changed on the network path. Use https or an encrypted tunnel.",
                    access.url,
                    ", the API key" if key else "",
                )
        return accesses

    def run(self, request: TokenRequest) -> TokenReply:
        """Answer one request.

        Raises:
            InvalidInputError: not a request that a server supports.
            NotReadyError: no answer in time, no server, or `abort` was called; a late answer is
                dropped.
            UnsafeError: the model produced NaN or infinity.
        """
        fleet, model = self._fleet, self._model
        if fleet is None or model is None:
            raise StateError("Runtime 'sglang' holds no model; load one first.")
        if not isinstance(request, TokenRequest):
            raise InvalidInputError(
                f"A request is a {type(request).__name__}, expected TokenRequest."
            )
        self._check_request(request, model)
        self._aborted.clear()
        deadline_s = time.monotonic() + self._config.timeout_s
        if request.deadline_s is not None:
            deadline_s = min(deadline_s, request.deadline_s)
        return self._answer(fleet, model, request, deadline_s)

    @staticmethod
    def _check_request(request: TokenRequest, model: PolicyModel) -> None:
        """Check the limits of an in-process runtime, so that both refuse the same requests."""
        count = request.prompt.ids.size
        if count > model.max_prompt_tokens:
            raise InvalidInputError(
                f"The prompt has {count} tokens, at most {model.max_prompt_tokens} fit.",
                hint="Shorten the instruction.",
            )
        if not 1 <= request.max_new_tokens <= model.max_new_tokens:
            raise InvalidInputError(
                f"{request.max_new_tokens} tokens were asked for, the model was loaded for 1 to "
                f"{model.max_new_tokens}."
            )

    def _answer(
        self, fleet: ServerPool, model: PolicyModel, request: TokenRequest, deadline_s: float
    ) -> TokenReply:
        started_s = time.monotonic()
        body = encode_body(request, self._config.image_format)
        encoded_s = time.monotonic()
        try:
            generated = fleet.generate(
                body,
                deadline_s,
                attempts=self._config.attempts,
                count=request.max_new_tokens,
                vocabulary=model.decoder.vocabulary,
                check=self._check,
            )
        except NotReadyError:
            self._check()  # raises the cause if it is local
            raise
        self._check()
        ended_s = time.monotonic()
        metrics = {
            **fleet.metrics(),
            **generated.metrics,
            "served.request_bytes": float(len(body)),
            "served.encode_ms": (encoded_s - started_s) * 1e3,
            "served.round_trip_ms": (ended_s - encoded_s) * 1e3,
            "model_ms": (ended_s - started_s) * 1e3,
        }
        return TokenReply(tokens=generated.tokens, metrics=metrics)

    def _check(self) -> None:
        if self._aborted.is_set():
            raise NotReadyError("The inference was aborted: abort was called.")
        self._check_process()

    def _check_process(self) -> None:
        if self._managed is not None:
            self._managed.check()

    def abort(self) -> None:
        """Abort the `run` in progress at once, also on its server."""
        self._aborted.set()
        fleet = self._fleet
        if fleet is not None:
            fleet.abort()

    def close(self) -> None:
        """Disconnect, and end the launched server."""
        self._aborted.set()
        fleet, self._fleet = self._fleet, None
        managed, self._managed = self._managed, None
        self._model = None
        if fleet is not None:
            fleet.close()
        if managed is not None:
            managed.stop()


if TYPE_CHECKING:
    _: type[TokenRuntime] = SglangRuntime
