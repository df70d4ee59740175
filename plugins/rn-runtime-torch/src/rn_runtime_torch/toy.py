"""The smallest policy that exercises the runtime: created at run time, for tests and the contract
kit.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from rn_runtime_torch.decoder import Decoder
from rn_vla.decoding import (
    DecoderShape,
    DecodingPrompt,
    PolicyModel,
    RowsRequest,
    Shard,
    TokenRequest,
    Weight,
)
from rn_vla.pruning import AttentionView, PrunableDecoder

FEATURES = 6
"""Width of each visual token's features, the array "features" (visual tokens, FEATURES)."""


_SHAPE = DecoderShape(
    hidden=32,
    intermediate=48,
    layers=4,
    heads=4,
    key_value_heads=2,
    vocabulary=96,
    norm_epsilon=1e-6,
    rope_theta=10000.0,
    max_positions=256,
)


class ToyFront(nn.Module):
    """First token, one linear layer over the visual features, the other tokens."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.projection = nn.Parameter(torch.empty(hidden, FEATURES))

    def forward(self, arrays: dict[str, Tensor], ids: Tensor, embed: nn.Module) -> Tensor:
        """See `rn_runtime_torch.passes.Front`."""
        words: Tensor = embed(ids)
        return torch.cat(
            (words[:, :1], arrays["features"] @ self.projection.T, words[:, 1:]), dim=1
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class ToyPolicy:
    """A random policy in a directory.

    Attributes:
        path: folder of its shards.
        shape: shape of the decoder.
        visual_tokens: visual tokens of each prompt.
        shards: number of weight files.
    """

    path: Path
    shape: DecoderShape = _SHAPE
    visual_tokens: int = 16
    shards: int = 3

    def write(self, seed: int = 0) -> None:
        """Write the shards with random bfloat16 values."""
        generator = torch.Generator().manual_seed(seed)
        for shard in self._files():
            tensors = {
                name: (
                    torch.randn(weight.shape, generator=generator) * weight.shape[-1] ** -0.5
                ).to(torch.bfloat16)
                for name, weight in shard.weights.items()
            }
            save_file(tensors, shard.path)

    def _files(self) -> tuple[Shard, ...]:
        with torch.device("meta"):
            slots = Decoder(self.shape, self.visual_tokens).slots()
        weights = {
            f"language_model.{n}": Weight(shape=tuple(t.shape), target=f"decoder.{n}")
            for n, t in slots.items()
        }
        weights["projection"] = Weight(
            shape=(self.shape.hidden, FEATURES), target="front.projection"
        )
        names = sorted(weights)
        return tuple(
            Shard(
                path=self.path / f"model-{index + 1:05}-of-{self.shards:05}.safetensors",
                weights={name: weights[name] for name in names[index :: self.shards]},
            )
            for index in range(self.shards)
        )

    def model(self, family: str = "openvla") -> PolicyModel:
        """The argument of `Runtime.load`; the family "openvla" decodes up to seven tokens, the
        other one none.
        """
        decodes = family == "openvla"
        return PolicyModel(
            family=family,
            checkpoint=self.path,
            decoder=self.shape,
            shards=self._files(),
            visual_tokens=self.visual_tokens,
            max_prompt_tokens=64,
            max_new_tokens=7 if decodes else 0,
            example=self.token_request if decodes else self.rows_request,
            build_front=functools.partial(ToyFront, self.shape.hidden),
        )

    def _prompt(self, count: int, seed: int) -> DecodingPrompt:
        generator = np.random.default_rng(seed)
        return DecodingPrompt(
            text="",
            ids=generator.integers(0, self.shape.vocabulary, count),
            images=(),
            arrays={
                "features": generator.standard_normal((self.visual_tokens, FEATURES)).astype(
                    np.float32
                )
            },
        )

    def token_request(self, count: int = 9, seed: int = 0) -> TokenRequest:
        """Decode seven tokens after `count` prompt tokens."""
        return TokenRequest(prompt=self._prompt(count, seed), max_new_tokens=7, with_logits=True)

    def rows_request(self, count: int = 9, seed: int = 0) -> RowsRequest:
        """Read four rows, two before the end."""
        return RowsRequest(prompt=self._prompt(count, seed), rows=4, tail=2, read="hidden")


class EveryOtherToken:
    """An acceleration that is its own selection: keeps every other visual token after one layer."""

    layer = 1

    def apply(self, decoder: PrunableDecoder) -> None:
        """See `roboneuron.contract.Acceleration`."""
        decoder.install_selection(self)

    def select(self, view: AttentionView) -> Tensor:
        """See `rn_vla.pruning.TokenSelection`."""
        start, end, count = (
            view.visual_start,
            view.visual_start + view.visual_count,
            view.key.shape[2],
        )
        parts = ((0, start, 1), (start, end, 2), (end, count, 1))
        # Created on the device: a host list cannot be copied while a CUDA graph is recorded.
        return torch.cat([torch.arange(*part, device=view.key.device) for part in parts])
