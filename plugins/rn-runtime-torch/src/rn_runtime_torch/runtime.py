"""The runtime `torch`: loads a model and answers its requests in this process."""

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
    """Implements `rn_vla.decoding.LlamaRuntime`; `run` is called from one thread, `abort` from
    any.
    """

    def __init__(self, config: TorchRuntimeConfig | None = None) -> None:
        self._config = config or TorchRuntimeConfig()
        self._engine: Engine | None = None
        self._aborted = threading.Event()

    def load(self, model: PolicyModel, acceleration: LlamaAcceleration | None = None) -> None:
        """Check the files, load the weights to the device, install the preset, warm up.

        Raises:
            InvalidInputError: not a model of a supported family.
            CheckpointError: files are damaged or belong to another model.
            ConfigurationError: the device does not exist, or the model or the preset does not fit.
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
        """Replace the preset, None for none; on the thread that calls `run`.

        Raises:
            ConfigurationError, PluginError: it does not fit; the previous one stays active.
        """
        if self._engine is None:
            raise StateError("Runtime 'torch' holds no model; load one first.")
        self._engine.set_acceleration(acceleration)

    def run(self, request: Request) -> Reply:
        """Answer one request.

        Raises:
            InvalidInputError: not a request, or one that exceeds what the model was loaded for.
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
        """Answer several requests that read the same rows in one pass, each within 1e-5 of the
        result of `run` in float32.

        Prompts may differ in length. An error of one request is raised for all. A single request is
        answered by `run`.

        Raises:
            InvalidInputError: there are none, or they read different rows, or as `run`.
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
        """Call `answer` and add its time; aborts at the earliest deadline, or on `abort`."""
        self._aborted.clear()
        started = time.perf_counter()
        deadline_s = min((r.deadline_s for r in requests if r.deadline_s is not None), default=None)

        def check() -> None:
            if self._aborted.is_set():
                raise NotReadyError("The inference was aborted: abort was called.")
            if deadline_s is not None and time.monotonic() > deadline_s:
                raise NotReadyError("The inference was aborted: its deadline passed.")

        check()
        replies = answer(check)
        check()
        model_ms = (time.perf_counter() - started) * 1e3
        return [
            replace(reply, metrics={**reply.metrics, "model_ms": model_ms}) for reply in replies
        ]

    def abort(self) -> None:
        """Abort the `run` in progress before its next token; a CUDA graph runs to its end first."""
        self._aborted.set()

    def close(self) -> None:
        """Release the model and its memory."""
        if self._engine is not None:
            self._engine = None
            from rn_runtime_torch.device import release_memory  # heavy: torch

            release_memory()


if TYPE_CHECKING:
    _: type[LlamaRuntime] = TorchRuntime
    _changer: type[LlamaAccelerationChanger] = TorchRuntime
    _batches: type[BatchRuntime] = TorchRuntime
