"""Gemma blocks whose norms depend on a condition, here the flow time of pi0.5."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from rn_backend_pi0.architecture import GemmaDims
from rn_backend_pi0.layers import GemmaBlock, KeyValue, Rotary


class AdaptiveRmsNorm(nn.Module):
    """RMS norm whose scale, shift and gate come from a condition, computed in float32."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.dense = nn.Linear(width, 3 * width)

    def forward(self, x: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """Normalise x with the condition's scale and shift; returns normed and gate in x's dtype.

        Args:
            x: (tokens, width).
            change: output of `dense` for the condition, float32 (3 width,) or, per token, (tokens,
                3 width).
        """
        scale, shift, gate = change.chunk(3, dim=-1)
        wide = x.float()
        wide = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return (wide * (1.0 + scale) + shift).to(x.dtype), gate.to(x.dtype)


class AdaptiveGemmaLayer(GemmaBlock):
    """A Gemma block with adaptive norms, whose gates scale the residual branches."""

    def __init__(self, dims: GemmaDims) -> None:
        super().__init__(dims)
        self.input_layernorm = AdaptiveRmsNorm(dims.width, dims.norm_eps)
        self.post_attention_layernorm = AdaptiveRmsNorm(dims.width, dims.norm_eps)

    def gated(
        self,
        x: Tensor,
        normed: Tensor,
        gate: Tensor,
        rotary: Rotary,
        cached: KeyValue,
        change: Tensor,
    ) -> Tensor:
        """Apply the block; every token attends to all of `cached`. Returns (tokens, width).

        Args:
            x: (tokens, width).
            normed, gate: output of the first norm for `x`.
            rotary: rotary embedding of these tokens.
            cached: keys and values of all visible tokens.
            change: condition of the second norm.
        """
        x = x + self.attended(normed, rotary, cached) * gate
        hidden, gate = self.post_attention_layernorm(x, change)
        return x + self.expanded(hidden) * gate


class AdaptiveGemma(nn.Module):
    """A stack of Gemma blocks with adaptive norms."""

    def __init__(self, dims: GemmaDims) -> None:
        super().__init__()
        self.layers = nn.ModuleList(AdaptiveGemmaLayer(dims) for _ in range(dims.depth))
        self.norm = AdaptiveRmsNorm(dims.width, dims.norm_eps)

    def blocks(self) -> list[AdaptiveGemmaLayer]:
        """The layers with their type."""
        return [cast("AdaptiveGemmaLayer", layer) for layer in self.layers]

    def norms(self) -> list[AdaptiveRmsNorm]:
        """All norms, in the order of use."""
        blocks = self.blocks()
        pairs = [(b.input_layernorm, b.post_attention_layernorm) for b in blocks]
        return [*(norm for pair in pairs for norm in pair), self.norm]
