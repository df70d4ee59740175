"""The vision towers: plain pre-norm vision transformers, read at their second to last block."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_vla.openvla.layout import TowerShape

_EPSILON = 1e-6


def gelu_in_place(x: Tensor) -> Tensor:
    """Exact GELU, overwriting `x`, because a new temporary costs a page fault on the CPU for each 4
    kB.
    """
    result: Tensor = torch.ops.aten.gelu_(x)
    return result


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        batch, count, width = x.shape
        query, key, value = self.qkv(x).view(batch, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        mixed = functional.scaled_dot_product_attention(query, key, value)
        projected: Tensor = self.proj(mixed.transpose(1, 2).reshape(batch, count, width))
        return projected


class _Mlp(nn.Module):
    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(width, inner)
        self.fc2 = nn.Linear(inner, width)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.fc2(gelu_in_place(self.fc1(x)))
        return result


class _Scale(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.scale_factor = nn.Parameter(torch.empty(width))

    def forward(self, x: Tensor) -> Tensor:
        return x.mul_(self.scale_factor)


class _Block(nn.Module):
    """A transformer block that adds its branches to its input, in place."""

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(shape.width, eps=_EPSILON)
        self.attn = _Attention(shape.width, shape.heads)
        self.ls1 = _Scale(shape.width) if shape.layer_scale else nn.Identity()
        self.norm2 = nn.LayerNorm(shape.width, eps=_EPSILON)
        self.mlp = _Mlp(shape.width, shape.intermediate)
        self.ls2 = _Scale(shape.width) if shape.layer_scale else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        x = x.add_(self.ls1(self.attn(self.norm1(x))))
        return x.add_(self.ls2(self.mlp(self.norm2(x))))


class _PatchEmbedding(nn.Module):
    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, shape.width, kernel_size=shape.patch, stride=shape.patch)

    def forward(self, pixels: Tensor) -> Tensor:
        grid: Tensor = self.proj(pixels)
        return grid.flatten(2).transpose(1, 2)


class Tower(nn.Module):
    """Encodes pixels (images, 3, side, side) as patch features (images, patches, width).

    Features are the output of the second to last block without the final norm; the last block is
    not used and neither held nor run. Source: Karamcheti et al. 2024 (Prismatic VLMs).
    """

    def __init__(self, shape: TowerShape) -> None:
        super().__init__()
        self.prefix_tokens = shape.prefix_tokens
        if shape.prefix_tokens:
            self.cls_token = nn.Parameter(torch.empty(1, 1, shape.width))
            self.reg_token = nn.Parameter(torch.empty(1, shape.prefix_tokens - 1, shape.width))
        self.pos_embed = nn.Parameter(torch.empty(1, shape.patches, shape.width))
        self.patch_embed = _PatchEmbedding(shape)
        self.blocks = nn.ModuleList(_Block(shape) for _ in range(shape.depth - 1))

    def forward(self, pixels: Tensor) -> Tensor:
        """See the class."""
        x: Tensor = self.patch_embed(pixels) + self.pos_embed
        if self.prefix_tokens:
            images = x.shape[0]
            x = torch.cat(
                (self.cls_token.expand(images, -1, -1), self.reg_token.expand(images, -1, -1), x),
                dim=1,
            )
        for block in self.blocks:
            x = block(x)
        return x[:, self.prefix_tokens :]
