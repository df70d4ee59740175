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
        """(tokens, width) and what `dense` makes of the condition -> normed and gate, in x's dtype.

        Args:
            x: (tokens, width).
            change: float32 (3 width,) or, one for each token, (tokens, 3 width).
        """
        scale, shift, gate = change.chunk(3, dim=-1)
        wide = x.float()
        wide = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return (wide * (1.0 + scale) + shift).to(x.dtype), gate.to(x.dtype)


class AdaptiveGemmaLayer(GemmaBlock):
    """A Gemma block with adaptive norms, whose gates weigh what the block adds."""

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
        """(tokens, width) -> the same shape, every token attending to all of `cached`.

        Args:
            x: (tokens, width).
            normed, gate: what the first norm made of `x`.
            rotary: of these tokens.
            cached: keys and values of all tokens that are seen.
            change: of the second norm.
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
        """The layers, typed."""
        return [cast("AdaptiveGemmaLayer", layer) for layer in self.layers]

    def norms(self) -> list[AdaptiveRmsNorm]:
        """All norms, in the order of use."""
        blocks = self.blocks()
        pairs = [(b.input_layernorm, b.post_attention_layernorm) for b in blocks]
        return [*(norm for pair in pairs for norm in pair), self.norm]
