"""The runtime `torch`: takes a model and answers its requests, in this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.plugin import FAMILIES
from rn_vla.decoding import (
    BatchRuntime,
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
            ConfigurationError: the device is not there, the model does not fit, or the preset does
                not.
        """
        if not isinstance(model, PolicyModel) or model.family not in FAMILIES:
            raise InvalidInputError(
                f"Runtime 'torch' got {model!r}, expected a PolicyModel of {', '.join(FAMILIES)}."
            )
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
            raise InvalidInputError(
                f"A request is a {type(request).__name__}, expected TokenRequest or RowsRequest."
            )
        engine = self._engine
        return self._timed((request,), lambda check: [engine.answer(request, check)])[0]

    def run_batch(self, requests: Sequence[RowsRequest]) -> list[Reply]:
        """Answer several requests that read alike in one pass, each within 1e-5 of what `run`
        answers in float32.

        Prompts may differ in length. What is wrong with one is raised for all. One alone is
        answered by `run`.

        Raises:
            InvalidInputError: they are none, or do not read alike, or as `run`.
            NotReadyError, UnsafeError: as `run`.
        """
        if self._engine is None:
            raise StateError("Runtime 'torch' holds no model; load one first.")
        if not all(isinstance(request, RowsRequest) for request in requests):
            raise InvalidInputError("Only requests of the kind RowsRequest are answered together.")
        if len({(request.rows, request.tail, request.read) for request in requests}) != 1:
            raise InvalidInputError(f"{len(requests)} requests do not read the same rows.")
        if len(requests) == 1:
            return [self.run(requests[0])]
        engine = self._engine
        return self._timed(requests, lambda check: engine.answer_batch(requests, check))

    def _timed(
        self, requests: Sequence[Request], answer: Callable[[Callable[[], None]], Sequence[Reply]]
    ) -> list[Reply]:
        """What `answer` returns, with its time; given up at the earliest deadline, or when
        aborted.
        """
        self._aborted.clear()
        started = time.perf_counter()
        deadline_s = min((r.deadline_s for r in requests if r.deadline_s is not None), default=None)

        def check() -> None:
            if self._aborted.is_set():
                raise NotReadyError("The inference was given up: abort was called.")
            if deadline_s is not None and time.monotonic() > deadline_s:
                raise NotReadyError("The inference was given up: its deadline passed.")

        check()
        replies = answer(check)
        check()
        model_ms = (time.perf_counter() - started) * 1e3
        return [
            replace(reply, metrics={**reply.metrics, "model_ms": model_ms}) for reply in replies
        ]

    def abort(self) -> None:
        """Give up the `run` in progress before its next token; a recorded CUDA graph runs to its
        end first.
        """
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
    _batches: type[BatchRuntime] = TorchRuntime
