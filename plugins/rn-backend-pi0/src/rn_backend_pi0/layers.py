"""The building blocks of pi0 as PyTorch modules: SigLIP for images, Gemma for language and
actions.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.architecture import GemmaDims, VisionDims

KeyValue = tuple[Tensor, Tensor]
"""Keys and values of one layer, (kv_heads, tokens, head_dim) each."""
Rotary = tuple[Tensor, Tensor]
"""Cosines and sines of the rotary embedding, (tokens, head_dim / 2) each."""


class VisionLayer(nn.Module):
    """One pre-norm transformer block of SigLIP."""

    def __init__(self, dims: VisionDims) -> None:
        super().__init__()
        self.heads = dims.heads
        self.layer_norm1 = nn.LayerNorm(dims.width, eps=dims.norm_eps)
        self.layer_norm2 = nn.LayerNorm(dims.width, eps=dims.norm_eps)
        parts = ("q_proj", "k_proj", "v_proj", "out_proj")
        self.self_attn = nn.ModuleDict({part: nn.Linear(dims.width, dims.width) for part in parts})
        self.mlp = nn.ModuleDict(
            {"fc1": nn.Linear(dims.width, dims.mlp), "fc2": nn.Linear(dims.mlp, dims.width)}
        )

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block to (cameras, tokens, width); same shape."""
        count, tokens, width = x.shape
        normed = self.layer_norm1(x)
        q, k, v = (
            self.self_attn[part](normed).view(count, tokens, self.heads, -1).transpose(1, 2)
            for part in ("q_proj", "k_proj", "v_proj")
        )
        mixed = (
            F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(count, tokens, width)
        )
        x = x + self.self_attn["out_proj"](mixed)
        hidden = F.gelu(self.mlp["fc1"](self.layer_norm2(x)), approximate="tanh")
        out: Tensor = x + self.mlp["fc2"](hidden)
        return out


class VisionTower(nn.Module):
    """SigLIP vision tower: pixels to tokens."""

    def __init__(self, dims: VisionDims) -> None:
        super().__init__()
        self.patch_embedding = nn.Conv2d(3, dims.width, kernel_size=dims.patch, stride=dims.patch)
        self.position_embedding = nn.Parameter(torch.empty(dims.tokens, dims.width))
        self.layers = nn.ModuleList(VisionLayer(dims) for _ in range(dims.depth))
        self.post_layernorm = nn.LayerNorm(dims.width, eps=dims.norm_eps)

    def forward(self, pixels: Tensor) -> Tensor:
        """Encode (cameras, 3, H, W) in -1..1 to (cameras, tokens, width)."""
        x = self.patch_embedding(pixels).flatten(2).transpose(1, 2) + self.position_embedding
        for layer in self.layers:
            x = layer(x)
        out: Tensor = self.post_layernorm(x)
        return out


class RmsNorm(nn.Module):
    """Gemma's RMS norm, computed in float32; the stored weight is an offset to 1."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.weight = nn.Parameter(torch.empty(width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise (tokens, width); same shape and dtype."""
        wide = x.float()
        wide = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return (wide * (1.0 + self.weight.float())).to(x.dtype)


def _rotate(x: Tensor, rotary: Rotary) -> Tensor:
    cos, sin = rotary
    first, second = x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1)


class GemmaBlock(nn.Module):
    """Attention and MLP of one Gemma block, without norms; with `keys_only` only the projections to
    keys and values.
    """

    def __init__(self, dims: GemmaDims, *, keys_only: bool = False) -> None:
        super().__init__()
        self.dims = dims
        queries, keys = dims.heads * dims.head_dim, dims.kv_heads * dims.head_dim
        self.self_attn = nn.ModuleDict(
            {
                "k_proj": nn.Linear(dims.width, keys, bias=False),
                "v_proj": nn.Linear(dims.width, keys, bias=False),
            }
        )
        if not keys_only:
            self.self_attn["q_proj"] = nn.Linear(dims.width, queries, bias=False)
            self.self_attn["o_proj"] = nn.Linear(queries, dims.width, bias=False)
            self.mlp = nn.ModuleDict(
                {
                    "gate_proj": nn.Linear(dims.width, dims.mlp, bias=False),
                    "up_proj": nn.Linear(dims.width, dims.mlp, bias=False),
                    "down_proj": nn.Linear(dims.mlp, dims.width, bias=False),
                }
            )

    def keys_values(self, normed: Tensor, rotary: Rotary) -> KeyValue:
        """Keys and values (kv_heads, tokens, head_dim) of normed (tokens, width); keys are
        rotated.
        """
        shape = (normed.shape[0], self.dims.kv_heads, self.dims.head_dim)
        key = self.self_attn["k_proj"](normed).view(shape).transpose(0, 1)
        value = self.self_attn["v_proj"](normed).view(shape).transpose(0, 1)
        return _rotate(key, rotary), value

    def attended(self, normed: Tensor, rotary: Rotary, cached: KeyValue) -> Tensor:
        """Output of attention to all of `cached`, for normed (tokens, width)."""
        dims, tokens = self.dims, normed.shape[0]
        groups = dims.heads // dims.kv_heads
        query = (
            self.self_attn["q_proj"](normed).view(tokens, dims.heads, dims.head_dim).transpose(0, 1)
        )
        query = _rotate(query, rotary).reshape(dims.kv_heads, groups * tokens, dims.head_dim)
        key, value = cached
        # Nothing is masked, so the query heads of one key head are handled as more queries.
        mixed = F.scaled_dot_product_attention(query[None], key[None], value[None])[0]
        mixed = mixed.reshape(dims.heads, tokens, dims.head_dim).transpose(0, 1).reshape(tokens, -1)
        out: Tensor = self.self_attn["o_proj"](mixed)
        return out

    def expanded(self, hidden: Tensor) -> Tensor:
        """Output of the MLP for normed (tokens, width)."""
        gate = F.gelu(self.mlp["gate_proj"](hidden), approximate="tanh")
        out: Tensor = self.mlp["down_proj"](gate * self.mlp["up_proj"](hidden))
        return out


class GemmaLayer(GemmaBlock):
    """One Gemma block with its norms."""

    def __init__(self, dims: GemmaDims, *, keys_only: bool = False) -> None:
        super().__init__(dims, keys_only=keys_only)
        self.input_layernorm = RmsNorm(dims.width, dims.norm_eps)
        if not keys_only:
            self.post_attention_layernorm = RmsNorm(dims.width, dims.norm_eps)

    def forward(self, x: Tensor, normed: Tensor, rotary: Rotary, cached: KeyValue) -> Tensor:
        """Apply the block to (tokens, width); every token attends to all of `cached`."""
        x = x + self.attended(normed, rotary, cached)
        out: Tensor = x + self.expanded(self.post_attention_layernorm(x))
        return out


class Gemma(nn.Module):
    """A stack of Gemma blocks; `keys_only_last` for the prefix, whose last hidden state is not
    used.
    """

    def __init__(self, dims: GemmaDims, *, keys_only_last: bool) -> None:
        super().__init__()
        self.dims = dims
        self.layers = nn.ModuleList(
            GemmaLayer(dims, keys_only=keys_only_last and index == dims.depth - 1)
            for index in range(dims.depth)
        )
        if not keys_only_last:
            self.norm = RmsNorm(dims.width, dims.norm_eps)

    def blocks(self) -> list[GemmaLayer]:
        """The layers with their type."""
        return [cast("GemmaLayer", layer) for layer in self.layers]
