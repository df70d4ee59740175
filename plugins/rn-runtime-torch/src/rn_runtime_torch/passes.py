"""Execution of a request by the parts of a loaded model, for tokens and for rows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor, nn

from rn_runtime_torch.cache import KeyValueCache
from rn_runtime_torch.decoder import Decoder
from rn_runtime_torch.fillings import Fillings
from rn_runtime_torch.graph import Computation
from rn_vla.decoding import PolicyModel, Request, RowsRequest, TokenRequest
from roboneuron import InvalidInputError

Kind = tuple[str | int, ...]
Check = Callable[[], None]
"""Raises if the answer is no longer needed."""


class Front(Protocol):
    """Return type of `PolicyModel.build_front`, besides being a torch module."""

    def __call__(
        self, arrays: dict[str, Tensor], ids: Tensor, embed: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Decoder input (b, positions, hidden) from arrays (b, ...), ids (b, n) and the embedding
        look-up.
        """
        ...


class Passes:
    """Computations on the parts of one model.

    Args:
        model: description of the loaded model.
        front, decoder, back: its parts, on one device.
        cache: for tokens; None for a model that decodes none.
    """

    def __init__(
        self,
        model: PolicyModel,
        front: Front,
        decoder: Decoder,
        back: nn.Module | None,
        cache: KeyValueCache | None,
    ) -> None:
        self._model = model
        self._front, self._decoder, self._back, self._cache = front, decoder, back, cache

    def of(self, request: Request, check: Check) -> tuple[Kind, Computation]:
        """The computation for a request, and the part of the request, besides the inputs, that
        determines its shapes.

        Raises:
            InvalidInputError: the request asks for more tokens than the model was loaded for.
        """
        if isinstance(request, TokenRequest):
            return self._tokens(request, check)
        return self.rows(request)

    def _tokens(self, request: TokenRequest, check: Check) -> tuple[Kind, Computation]:
        decoder, cache = self._decoder, self._cache
        if cache is None or not 1 <= request.max_new_tokens <= self._model.max_new_tokens:
            raise InvalidInputError(
                f"{request.max_new_tokens} tokens were asked for, the model was loaded for "
                f"1 to {self._model.max_new_tokens}."
            )

        def compute(held: dict[str, Tensor]) -> dict[str, Tensor]:
            hidden = self._embed(held)
            position = hidden.shape[1]
            hidden = decoder(hidden, causal=True, cache=cache, last=1)
            logits = first = decoder.logits(hidden)[:, -1]
            finite = torch.isfinite(logits).all()
            tokens = [logits.argmax(dim=-1)]
            while len(tokens) < request.max_new_tokens:
                check()
                hidden = decoder.step(decoder.embed(tokens[-1])[None], position, cache)
                logits = decoder.logits(hidden)[:, -1]
                finite = finite & torch.isfinite(logits).all()
                tokens.append(logits.argmax(dim=-1))
                position += 1
            return {"tokens": torch.cat(tokens), "logits": first[0], "finite": finite}

        return ("tokens", request.max_new_tokens), compute

    def rows(
        self, request: RowsRequest, fillings: Fillings | None = None
    ) -> tuple[Kind, Computation]:
        """The computation that reads rows of the last hidden states in one pass; `fillings` gives
        the padding if requests of different lengths are answered together.
        """
        decoder, back = self._decoder, self._back

        def compute(held: dict[str, Tensor]) -> dict[str, Tensor]:
            hidden = self._embed(held)
            end = hidden.shape[1] - request.tail
            last = request.rows + request.tail
            hidden = decoder(
                hidden, causal=False, rows=(end - request.rows, end), last=last, fillings=fillings
            )
            values = hidden[:, : request.rows]
            finite = torch.isfinite(values).all()
            if request.read == "output" and back is not None:
                values = back(values)
                finite = finite & torch.isfinite(values).all()
            elif request.read == "tokens":
                logits = decoder.logits(values)
                finite = finite & torch.isfinite(logits).all()
                values = logits.argmax(dim=-1)
            return {"values": values.float(), "finite": finite}

        return ("rows", request.rows, request.tail, request.read), compute

    def _embed(self, held: dict[str, Tensor]) -> Tensor:
        arrays = {name: tensor for name, tensor in held.items() if name != "ids"}
        return self._front(arrays, held["ids"], self._decoder.embed)
