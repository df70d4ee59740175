"""A loaded model: front, decoder and back on one device, and the execution of requests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.config import MOST_RECORDINGS, WARM_LENGTHS, TorchRuntimeConfig
from rn_runtime_torch.decoder import MATRICES, Decoder
from rn_runtime_torch.device import (
    Needs,
    check_fits,
    choose_device,
    choose_dtype,
    free_bytes,
    memory_errors,
)
from rn_runtime_torch.fillings import Fillings, fill_up
from rn_runtime_torch.graph import Computation, GraphCache
from rn_runtime_torch.int8 import check_int8
from rn_runtime_torch.memory import PeakBytes
from rn_runtime_torch.passes import Check, Front, Kind, Passes
from rn_runtime_torch.scratch import Scratch
from rn_runtime_torch.weights import check_shards, load_shards
from rn_vla.decoding import (
    LlamaAcceleration,
    PolicyModel,
    Reply,
    Request,
    RowsReply,
    RowsRequest,
    TokenReply,
    TokenRequest,
)
from rn_vla.pruning import TokenSelection
from roboneuron import ConfigurationError, InvalidInputError, UnsafeError

Key = tuple[TokenSelection | None, Kind, tuple[tuple[str, tuple[int, ...]], ...]]
"""Key of a recording: the preset's selection, the kind of request, shapes by input."""
_BATCH_SHARE = 0.5
"""Fraction of the memory free after loading; a pass takes only as many requests as fit into it."""
_TRIAL_TOKENS = 8
"""Prompt length of the test sequence for a new selection: text tokens before and after the
image.
"""


class Engine:
    """Created once per model; every method runs on the caller's thread.

    Raises, when created:
        CheckpointError: files are damaged or belong to another model.
        ConfigurationError: the device does not exist, or the model or the preset does not fit.
    """

    def __init__(
        self, model: PolicyModel, config: TorchRuntimeConfig, acceleration: LlamaAcceleration | None
    ) -> None:
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        self._model = model
        self._is_compiled = config.compile
        self._records_at_change = config.record_at_change
        self._latest: Request | None = None
        self._device = choose_device(config)
        self._dtype = choose_dtype(config, self._device)
        check_shards(model.shards)
        with memory_errors(self._device), torch.inference_mode():
            self._graphs = (
                GraphCache(self._device)
                if self._device.type == "cuda" and config.cuda_graphs
                else None
            )
            self._recording = False
            self._build(config)
            if acceleration is not None:
                acceleration.apply(self._decoder)
            if config.compile:
                _compile(self._decoder)
            self._recording = self._graphs is not None
            for length in self._warm_lengths(config):
                self.answer(model.example(length), lambda: None)
            self._recording = False
        self._most = max(
            1, int(_BATCH_SHARE * free_bytes(self._device) / max(1, self._activations))
        )

    def _build(self, config: TorchRuntimeConfig) -> None:
        model, device, dtype = self._model, self._device, self._dtype
        length = (
            model.visual_tokens
            + model.max_prompt_tokens
            + model.extra_tokens
            + model.max_new_tokens
        )
        if length > model.decoder.max_positions:
            raise ConfigurationError(
                f"Prompts of {model.max_prompt_tokens} tokens make sequences of {length} "
                "positions, "
                f"but the checkpoint supports {model.decoder.max_positions}."
            )
        with torch.device("meta"):
            front: nn.Module = model.build_front()
            decoder = Decoder(model.decoder, model.visual_tokens)
            back: nn.Module | None = model.build_back() if model.build_back is not None else None
        parts: dict[str, nn.Module] = {"front": front, "decoder": decoder}
        if back is not None:
            parts["back"] = back
        self._front, self._decoder, self._back = cast(Front, front), decoder, back
        quantized = config.decode_weights == "int8" and model.max_new_tokens > 0
        if quantized:
            check_int8(device)
        for part in parts.values():
            part.to(dtype).eval()
        self._place_state(length, torch.device("meta"))
        needs = self._needs(config, list(parts.values()), quantized)
        check_fits(needs, device, dtype)
        self._activations = needs.activations
        for part in parts.values():
            part.to_empty(device=device)
        slots = {f"decoder.{name}": slot for name, slot in decoder.slots().items()}
        for word in parts.keys() - {"decoder"}:
            slots |= {f"{word}.{name}": slot.data for name, slot in parts[word].named_parameters()}
        load_shards(model.shards, slots)
        self._place_state(length, device)
        decoder.scratch = Scratch(keep=device.type == "cpu" and not config.compile)
        if quantized:
            decoder.quantize()

    def _place_state(self, length: int, device: torch.device) -> None:
        """Create rotary tables and cache on `device`."""
        shape = self._model.decoder
        self._decoder.prepare_positions(device, self._dtype)
        self._cache = (
            KeyValueCache(shape, length, device, self._dtype)
            if self._model.max_new_tokens
            else None
        )
        self._passes = Passes(self._model, self._front, self._decoder, self._back, self._cache)

    def _needs(self, config: TorchRuntimeConfig, parts: list[nn.Module], quantized: bool) -> Needs:
        """Memory of the longest request, determined by running it on the parts while they are on
        the device "meta".
        """
        model, dtype = self._model, self._dtype
        parameters = [parameter for part in parts for parameter in part.parameters()]
        tables = [table for part in parts for table in part.buffers()]
        request = model.example(model.max_prompt_tokens - self._added_tokens())
        inputs = {
            name: torch.empty((1, *array.shape), dtype=dtype, device="meta")
            for name, array in request.prompt.arrays.items()
        }
        inputs["ids"] = torch.empty((1, request.prompt.ids.size), dtype=torch.int64, device="meta")
        kept = self._cache.tensors() if self._cache is not None else ()
        with PeakBytes([*parameters, *tables, *kept]) as peak:
            self._passes.of(request, lambda: None)[1](inputs)
        weights = sum(parameter.numel() for parameter in parameters) * dtype.itemsize
        if quantized:
            weights += sum(
                getattr(layer, name).numel() for layer in self._decoder.layers for name in MATRICES
            )
        return Needs(
            weights=weights,
            cache=sum(tensor.nbytes for tensor in kept),
            activations=peak.peak,
            recordings=len(self._warm_lengths(config)) if self._graphs is not None else 0,
        )

    def _added_tokens(self) -> int:
        """Number of ids that the family adds to each prompt."""
        return int(self._model.example(1).prompt.ids.size) - 1

    def _warm_lengths(self, config: TorchRuntimeConfig) -> range:
        first = self._model.min_prompt_tokens
        last = first + WARM_LENGTHS - 1
        if config.warm_prompt_tokens is not None:
            first, last = config.warm_prompt_tokens
        last = min(last, self._model.max_prompt_tokens - self._added_tokens())
        first = min(first, last)
        return range(first, (first if self._graphs is None else last) + 1)

    def set_acceleration(self, acceleration: LlamaAcceleration | None) -> None:
        """Answer later requests with another preset; weights, cache and recordings are kept.

        On CUDA the shape of the latest request is recorded with the new preset, unless the options
        disable it. This takes about three predictions, once; later ones with the current
        instruction are replayed. Other shapes under this preset run unrecorded; recordings of
        earlier presets are replayed when these are active again.

        Raises:
            ConfigurationError: the preset does not fit this model, or layers are compiled.
            PluginError: the preset keeps invalid positions, or drops required ones.
        """
        if self._is_compiled:
            raise ConfigurationError(
                "Compiled layers would be recompiled for each preset, which takes longer than "
                "the robot can wait.",
                hint='Leave out compile = true, or switch with mode = "cold".',
            )
        decoder = self._decoder
        before, decoder.selection = decoder.selection, None
        try:
            with memory_errors(self._device), torch.inference_mode():
                if acceleration is not None:
                    acceleration.apply(decoder)
                self._try_selection()
                self._record_latest()
        except BaseException:
            decoder.selection = before
            raise

    def _record_latest(self) -> None:
        """Record the latest request with the current selection, unless it is recorded already or
        the limit of recordings is reached.
        """
        if self._graphs is None or self._latest is None or not self._records_at_change:
            return
        if len(self._graphs) >= MOST_RECORDINGS:
            return
        self._recording = True
        try:
            self.answer(self._latest, lambda: None)
        finally:
            self._recording = False

    def _try_selection(self) -> None:
        """Call the selection once, so that an invalid one is refused now and not by the next
        request.
        """
        model = self._model
        request = model.example(min(_TRIAL_TOKENS, model.max_prompt_tokens - self._added_tokens()))
        count = model.visual_tokens + model.extra_tokens + int(request.prompt.ids.size)
        if isinstance(request, TokenRequest):
            self._decoder.try_selection(count, causal=True)
        else:
            end = count - request.tail
            self._decoder.try_selection(count, causal=False, rows=(end - request.rows, end))

    def answer(self, request: Request, check: Check) -> Reply:
        """Run one request; `check` is called between decoding steps.

        Raises:
            InvalidInputError: the prompt or the number of tokens exceeds what the model was loaded
                for.
            UnsafeError: the model produced NaN or infinity.
        """
        self._check_prompt(request.prompt.ids)
        with memory_errors(self._device), torch.inference_mode():
            inputs = {
                name: torch.from_numpy(array)[None].to(self._device, self._dtype)
                for name, array in request.prompt.arrays.items()
            }
            inputs["ids"] = torch.from_numpy(request.prompt.ids)[None].to(self._device)
            self._latest = request
            outputs, kept = self._execute(*self._passes.of(request, check), inputs)
            if not bool(outputs["finite"]):
                raise UnsafeError(
                    "The model produced NaN or infinite values; no action was created."
                )
            metrics, note = {"tokens_kept": float(kept)}, ""
            if self._graphs is not None:
                metrics["recorded"] = float(self._graphs.was_replayed)
                note = (
                    ""
                    if self._graphs.was_replayed
                    else self._explain_eager(request.prompt.ids.size)
                )
            if isinstance(request, TokenRequest):
                logits = outputs["logits"].cpu().numpy() if request.with_logits else None
                return TokenReply(
                    tokens=outputs["tokens"].cpu().numpy(),
                    logits=logits,
                    metrics=metrics,
                    note=note,
                )
            return RowsReply(values=outputs["values"][0].cpu().numpy(), metrics=metrics, note=note)

    def _explain_eager(self, ids: int) -> str:
        """Reason why a prompt with this number of ids was not replayed from a CUDA graph; token
        numbers as in the options.
        """
        assert self._graphs is not None
        added = self._added_tokens()
        recorded = sorted(
            size - added
            for selection, _, shapes in (cast("Key", key) for key in self._graphs.keys())  # noqa: SIM118
            if selection == self._decoder.selection
            for name, (_, size, *_) in shapes
            if name == "ids"
        )
        if not recorded:
            return "CUDA graph: eager, none is recorded for the current preset."
        span = f"{recorded[0]} to {recorded[-1]}" if len(recorded) > 1 else f"{recorded[0]} only"
        return f"CUDA graph: eager, prompt of {ids - added} tokens (recorded: {span})."

    def answer_batch(self, requests: Sequence[RowsRequest], check: Check) -> list[RowsReply]:
        """Answer requests that read the same rows in one pass, or in as few as memory allows;
        `check` is called between them.

        On CUDA such passes run unrecorded, which their note states. Raises as `answer`; an error of
        one request is raised for all.
        """
        for request in requests:
            self._check_prompt(request.prompt.ids)
        replies: list[RowsReply] = []
        with memory_errors(self._device), torch.inference_mode():
            for first in range(0, len(requests), self._most):
                check()
                replies += self._answer_together(requests[first : first + self._most])
        return replies

    def _answer_together(self, requests: Sequence[RowsRequest]) -> list[RowsReply]:
        prompts = [request.prompt for request in requests]
        inputs = {
            name: torch.from_numpy(np.stack([prompt.arrays[name] for prompt in prompts])).to(
                self._device, self._dtype
            )
            for name in prompts[0].arrays
        }
        ids, counts = fill_up([prompt.ids for prompt in prompts])
        inputs["ids"] = torch.from_numpy(ids).to(self._device)
        start = 1 + self._model.visual_tokens + self._model.extra_tokens
        outputs = self._passes.rows(requests[0], Fillings(start, counts))[1](inputs)
        if not bool(outputs["finite"]):
            raise UnsafeError("The model produced NaN or infinite values; no action was created.")
        metrics, note = (
            {"tokens_kept": float(self._decoder.visual_kept), "batch": float(len(requests))},
            "",
        )
        if self._graphs is not None:
            metrics["recorded"], note = 0.0, f"CUDA graph: eager, batch of {len(requests)}."
        return [
            RowsReply(values=values, metrics=metrics, note=note)
            for values in outputs["values"].cpu().numpy()
        ]

    def _check_prompt(self, ids: NDArray[np.int64]) -> None:
        if ids.size > self._model.max_prompt_tokens:
            raise InvalidInputError(
                f"The prompt has {ids.size} tokens, at most {self._model.max_prompt_tokens} fit.",
                hint="Shorten the instruction.",
            )
        _check_ids(ids, self._model.decoder.vocabulary)

    def _execute(
        self, kind: Kind, compute: Computation, inputs: dict[str, Tensor]
    ) -> tuple[dict[str, Tensor], int]:
        if self._graphs is not None:
            shapes = tuple((name, tuple(tensor.shape)) for name, tensor in sorted(inputs.items()))
            key: Key = (self._decoder.selection, kind, shapes)
            if self._recording and key not in self._graphs:
                self._graphs.record(key, compute, inputs, lambda: self._decoder.visual_kept)
            found = self._graphs.run(key, inputs)
            if found is not None:
                return found
        return compute(inputs), self._decoder.visual_kept


def _check_ids(ids: NDArray[np.int64], vocabulary: int) -> None:
    """Raise InvalidInputError for an id without an embedding: on a GPU the look-up would corrupt
    the whole CUDA context.
    """
    if not ids.size or ids.min() < 0 or ids.max() >= vocabulary:
        span = f"{ids.min()} to {ids.max()}" if ids.size else "none"
        raise InvalidInputError(
            f"The prompt's ids are {span}, expected some from 0 to {vocabulary - 1}."
        )


def _compile(decoder: Decoder) -> None:
    """Compile the parts around attention in each layer; layers are alike, so one compilation serves
    all.
    """
    for layer in decoder.layers:
        for name in ("project", "merge"):
            setattr(layer, name, torch.compile(getattr(layer, name)))
