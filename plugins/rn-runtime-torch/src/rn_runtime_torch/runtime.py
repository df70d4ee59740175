"""The runtime `torch`: takes a model's weights and answers its requests, in this process."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
import torch
from torch import Tensor, nn

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.config import TorchRuntimeConfig
from rn_runtime_torch.decoder import Decoder
from rn_runtime_torch.device import check_fits, choose_device, choose_dtype
from rn_runtime_torch.graph import GraphCache
from rn_runtime_torch.weights import check_shards, load_shards
from roboneuron.contract.decoding import PolicyModel, Request, RowsReply, RowsRequest, TokenReply, TokenRequest
from roboneuron.contract.protocols import Acceleration
from roboneuron.errors import ConfigurationError, InvalidInputError, NotReadyError, StateError, UnsafeError

log = logging.getLogger(__name__)


class Front(Protocol):
    """What `PolicyModel.build_front` returns, besides being a torch module."""

    def __call__(self, arrays: dict[str, Tensor], ids: Tensor, embed: Callable[[Tensor], Tensor]) -> Tensor:
        """Arrays (1, ...), ids (1, n) and the embedding look-up -> decoder input (1, positions, hidden)."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Loaded:
    model: PolicyModel
    device: torch.device
    dtype: torch.dtype
    front: Front
    decoder: Decoder
    back: nn.Module | None
    cache: KeyValueCache | None
    graphs: GraphCache | None


class TorchRuntime:
    """Follows `roboneuron.contract.Runtime`; `run` is called from one thread, `abort` from any."""

    def __init__(self, config: TorchRuntimeConfig | None = None) -> None:
        self._config = config or TorchRuntimeConfig()
        self._loaded: _Loaded | None = None
        self._aborted = threading.Event()

    def load(self, model: PolicyModel, acceleration: Acceleration | None = None) -> None:
        """Check the files, put the weights on the device, install the preset, warm up.

        Raises:
            CheckpointError: files that are damaged or are not this model's.
            ConfigurationError: the device is not there, the model does not fit, or the preset does not.
        """
        if self._loaded is not None:
            raise StateError("Runtime 'torch' already holds a model; close it first.")
        if self._config.threads is not None:
            torch.set_num_threads(self._config.threads)
        device = choose_device(self._config)
        dtype = choose_dtype(self._config, device)
        check_shards(model.shards)
        with _memory_errors(device), torch.inference_mode():
            self._loaded = loaded = self._build(model, device, dtype)
            try:
                if acceleration is not None:
                    acceleration.apply(loaded.decoder)
                if self._config.compile:
                    _compile(loaded.decoder)
                for length in self._warm_lengths(loaded):
                    self.run(model.example(length))
            except BaseException:
                self.close()
                raise

    def _build(self, model: PolicyModel, device: torch.device, dtype: torch.dtype) -> _Loaded:
        with torch.device("meta"):
            front = model.build_front()
            decoder = Decoder(model.decoder, model.visual_tokens)
            back = model.build_back() if model.build_back is not None else None
        parts: dict[str, nn.Module] = {"front": front, "decoder": decoder}
        if back is not None:
            parts["back"] = back
        length = model.visual_tokens + model.max_prompt_tokens + model.extra_tokens + model.max_new_tokens
        if length > model.decoder.max_positions:
            raise ConfigurationError(
                f"Prompts of {model.max_prompt_tokens} tokens make sequences of {length} positions, "
                f"but the checkpoint knows {model.decoder.max_positions}."
            )
        count = sum(parameter.numel() for part in parts.values() for parameter in part.parameters())
        check_fits(count * dtype.itemsize, device, dtype)
        for part in parts.values():
            part.to(dtype).to_empty(device=device)
            part.eval()
        slots = {f"decoder.{name}": slot for name, slot in decoder.slots().items()}
        for word in ("front", "back"):
            if word in parts:
                slots |= {f"{word}.{name}": slot.data for name, slot in parts[word].named_parameters()}
        load_shards(model.shards, slots)
        decoder.prepare_positions(device, dtype)
        cache = KeyValueCache(model.decoder, length, device, dtype) if model.max_new_tokens else None
        graphs = GraphCache(device) if device.type == "cuda" and self._config.cuda_graphs else None
        return _Loaded(
            model=model,
            device=device,
            dtype=dtype,
            front=cast(Front, front),
            decoder=decoder,
            back=back,
            cache=cache,
            graphs=graphs,
        )

    def _warm_lengths(self, loaded: _Loaded) -> range:
        first, last = self._config.warm_prompt_tokens
        last = min(last, loaded.model.max_prompt_tokens)
        first = min(first, last)
        return range(first, (last if loaded.graphs is not None else first) + 1)

    def run(self, request: Request) -> TokenReply | RowsReply:
        """Answer one request.

        Raises:
            InvalidInputError: the prompt is too long.
            NotReadyError: the deadline passed or `abort` was called.
            UnsafeError: the model produced NaN or infinity.
        """
        loaded = self._loaded
        if loaded is None:
            raise StateError("Runtime 'torch' holds no model; load one first.")
        self._aborted.clear()
        count = request.prompt.ids.size
        if count > loaded.model.max_prompt_tokens:
            raise InvalidInputError(
                f"The prompt has {count} tokens, at most {loaded.model.max_prompt_tokens} fit.",
                hint="Shorten the instruction.",
            )
        started = time.perf_counter()
        with _memory_errors(loaded.device), torch.inference_mode():
            inputs = _to_device(request, loaded)
            if isinstance(request, TokenRequest):
                outputs, kept = self._decode(request, inputs, loaded)
            else:
                outputs, kept = self._read_rows(request, inputs, loaded)
            if not bool(outputs["finite"]):
                raise UnsafeError("The model produced NaN or infinite values; no action was made of them.")
            on_host = {name: tensor.cpu().numpy() for name, tensor in outputs.items()}
        metrics = {"model_ms": (time.perf_counter() - started) * 1e3, "tokens_kept": float(kept)}
        if isinstance(request, TokenRequest):
            logits = on_host["logits"] if request.with_logits else None
            return TokenReply(tokens=on_host["tokens"], logits=logits, metrics=metrics)
        return RowsReply(values=on_host["values"].astype(np.float32), metrics=metrics)

    def abort(self) -> None:
        """Give up the `run` in progress before its next token; a recorded CUDA graph runs to its end."""
        self._aborted.set()

    def close(self) -> None:
        """Drop the model and its memory."""
        held, self._loaded = self._loaded, None
        if held is not None and held.device.type == "cuda":
            del held
            torch.cuda.empty_cache()

    def _decode(
        self, request: TokenRequest, inputs: dict[str, Tensor], loaded: _Loaded
    ) -> tuple[dict[str, Tensor], int]:
        if loaded.cache is None or request.max_new_tokens > loaded.model.max_new_tokens:
            raise InvalidInputError(
                f"{request.max_new_tokens} tokens were asked for, the model was loaded for "
                f"{loaded.model.max_new_tokens}."
            )
        decoder, cache = loaded.decoder, loaded.cache
        check = self._check_wanted if loaded.graphs is None else lambda _: None

        def compute(held: dict[str, Tensor]) -> dict[str, Tensor]:
            hidden = _front(loaded, held)
            position = hidden.shape[1]
            hidden = decoder(hidden, causal=True, cache=cache)[:, -1:]
            kept = decoder.visual_kept
            logits = first = decoder.logits(hidden)[:, -1]
            finite = torch.isfinite(logits).all()
            tokens = [logits.argmax(dim=-1)]
            while len(tokens) < request.max_new_tokens:
                check(request.deadline_s)
                hidden = decoder.step(decoder.embed(tokens[-1])[None], position, cache)
                logits = decoder.logits(hidden)[:, -1]
                finite = finite & torch.isfinite(logits).all()
                tokens.append(logits.argmax(dim=-1))
                position += 1
            decoder.visual_kept = kept
            return {"tokens": torch.cat(tokens), "logits": first[0], "finite": finite}

        self._check_wanted(request.deadline_s)
        return _execute(loaded, ("tokens", request.max_new_tokens), compute, inputs)

    def _read_rows(
        self, request: RowsRequest, inputs: dict[str, Tensor], loaded: _Loaded
    ) -> tuple[dict[str, Tensor], int]:
        decoder, back = loaded.decoder, loaded.back

        def compute(held: dict[str, Tensor]) -> dict[str, Tensor]:
            hidden = _front(loaded, held)
            end = hidden.shape[1] - request.tail
            hidden = decoder(hidden, causal=False, rows=(end - request.rows, end))
            end = hidden.shape[1] - request.tail
            values = hidden[:, end - request.rows : end]
            finite = torch.isfinite(values).all()
            if request.read == "output" and back is not None:
                values = back(values)
                finite = finite & torch.isfinite(values).all()
            elif request.read == "tokens":
                logits = decoder.logits(values)
                finite = finite & torch.isfinite(logits).all()
                values = logits.argmax(dim=-1)
            return {"values": values[0].float(), "finite": finite}

        self._check_wanted(request.deadline_s)
        return _execute(loaded, ("rows", request.rows, request.tail, request.read), compute, inputs)

    def _check_wanted(self, deadline_s: float | None) -> None:
        if self._aborted.is_set():
            raise NotReadyError("The inference was given up: abort was called.")
        if deadline_s is not None and time.monotonic() > deadline_s:
            raise NotReadyError("The inference was given up: its deadline passed.")


def _front(loaded: _Loaded, held: dict[str, Tensor]) -> Tensor:
    arrays = {name: tensor for name, tensor in held.items() if name != "ids"}
    return loaded.front(arrays, held["ids"], loaded.decoder.embed)


def _execute(
    loaded: _Loaded,
    kind: tuple[str | int, ...],
    compute: Callable[[dict[str, Tensor]], dict[str, Tensor]],
    inputs: dict[str, Tensor],
) -> tuple[dict[str, Tensor], int]:
    if loaded.graphs is None:
        return compute(inputs), loaded.decoder.visual_kept
    key = (kind, tuple((name, tuple(tensor.shape)) for name, tensor in sorted(inputs.items())))
    return loaded.graphs.run(key, compute, inputs, lambda: loaded.decoder.visual_kept)


def _to_device(request: Request, loaded: _Loaded) -> dict[str, Tensor]:
    inputs = {
        name: torch.from_numpy(array)[None].to(loaded.device, loaded.dtype)
        for name, array in request.prompt.arrays.items()
    }
    inputs["ids"] = torch.from_numpy(request.prompt.ids)[None].to(loaded.device)
    return inputs


def _compile(decoder: Decoder) -> None:
    """Compile what surrounds attention in each layer; layers are alike, so one compilation serves all."""
    for layer in decoder.layers:
        for name in ("project", "merge"):
            setattr(layer, name, torch.compile(getattr(layer, name)))


@contextmanager
def _memory_errors(device: torch.device) -> Iterator[None]:
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, torch.OutOfMemoryError) or "allocate memory" in str(error):
            raise ConfigurationError(
                f"Out of memory on {device}: {str(error).splitlines()[0]}",
                hint="Free memory, choose a smaller dtype or another device.",
            ) from error
        raise
