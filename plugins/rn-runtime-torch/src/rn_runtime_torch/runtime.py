"""The runtime `torch`: takes a model and answers its requests, in this process."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.plugin import FAMILIES
from rn_vla.decoding import (
    LlamaAcceleration,
    LlamaAccelerationChanger,
    LlamaRuntime,
    PolicyModel,
    Reply,
    Request,
    RowsRequest,
    TokenRequest,
)
from roboneuron import InvalidInputError, NotReadyError, StateError

if TYPE_CHECKING:
    from rn_runtime_torch.engine import Engine


class TorchRuntime:
    """Follows `rn_vla.decoding.LlamaRuntime`; `run` is called from one thread, `abort` from any."""

    def __init__(self, config: TorchRuntimeConfig | None = None) -> None:
        self._config = config or TorchRuntimeConfig()
        self._engine: Engine | None = None
        self._aborted = threading.Event()

    def load(self, model: PolicyModel, acceleration: LlamaAcceleration | None = None) -> None:
        """Check the files, put the weights on the device, install the preset, warm up.

        Raises:
            InvalidInputError: not a model of a family it knows.
            CheckpointError: files that are damaged or are not this model's.
            ConfigurationError: the device is not there, the model does not fit, or the preset does not.
        """
        if not isinstance(model, PolicyModel) or model.family not in FAMILIES:
            raise InvalidInputError(f"Runtime 'torch' got {model!r}, expected a PolicyModel of {', '.join(FAMILIES)}.")
        if self._engine is not None:
            raise StateError("Runtime 'torch' already holds a model; close it first.")
        from rn_runtime_torch.engine import Engine  # heavy: torch

        self._engine = Engine(model, self._config, acceleration)

    def set_acceleration(self, acceleration: LlamaAcceleration | None) -> None:
        """Change the preset, or install none; on the thread that calls `run`.

        Raises:
            ConfigurationError, PluginError: why it does not fit; the former one stays in force.
        """
        if self._engine is None:
            raise StateError("Runtime 'torch' holds no model; load one first.")
        self._engine.set_acceleration(acceleration)

    def run(self, request: Request) -> Reply:
        """Answer one request.

        Raises:
            InvalidInputError: not a request, or more than the model was loaded for.
            NotReadyError: the deadline passed or `abort` was called.
            UnsafeError: the model produced NaN or infinity.
        """
        if self._engine is None:
            raise StateError("Runtime 'torch' holds no model; load one first.")
        if not isinstance(request, TokenRequest | RowsRequest):
            raise InvalidInputError(f"A request is a {type(request).__name__}, expected TokenRequest or RowsRequest.")
        self._aborted.clear()
        started = time.perf_counter()

        def check() -> None:
            if self._aborted.is_set():
                raise NotReadyError("The inference was given up: abort was called.")
            if request.deadline_s is not None and time.monotonic() > request.deadline_s:
                raise NotReadyError("The inference was given up: its deadline passed.")

        check()
        reply = self._engine.answer(request, check)
        check()
        model_ms = (time.perf_counter() - started) * 1e3
        return replace(reply, metrics={**reply.metrics, "model_ms": model_ms})

    def abort(self) -> None:
        """Give up the `run` in progress before its next token; a recorded CUDA graph runs to its end first."""
        self._aborted.set()

    def close(self) -> None:
        """Drop the model and its memory."""
        if self._engine is not None:
            self._engine = None
            from rn_runtime_torch.device import release_memory  # heavy: torch

            release_memory()


if TYPE_CHECKING:
    _: type[LlamaRuntime] = TorchRuntime
    _changer: type[LlamaAccelerationChanger] = TorchRuntime
