"""The network, trainable and batched: the same function that rn-backend-oft computes from the
exported checkpoint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_policy_cubes.recipe import (
    ACTION_WIDTH,
    PATCH_VALUES,
    PATCHES,
    PLACEHOLDERS,
    ROWS,
    STATE_WIDTH,
    VOCABULARY,
    NetworkShape,
)

PIXELS = (
    ((0.484375, 0.455078125, 0.40625), (0.228515625, 0.2236328125, 0.224609375)),
    ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
)
"""Mean and standard deviation of both towers' pixels."""
PREFIX_TOKENS = (5, 0)
MLP_RATIO = (4.0, 3.7362)
_VISION_EPSILON, _DECODER_EPSILON = 1e-6, 1e-6
_MOST_POSITIONS = 1024
STOP_ID = 2


@dataclass(frozen=True, slots=True)
class Look:
    """The visual input of a batch of views.

    Attributes:
        pixels: uint8 (views, tokens, 588), patches, channel first.
        index: int64 (views, tokens), their indices among the 256 patches, ascending.
        weight: float (views, tokens), number of patches that each represents; None for 1 each.
    """

    pixels: Tensor
    index: Tensor
    weight: Tensor | None


def attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor | None) -> Tensor:
    """Unfused attention: on a CPU in bfloat16 its backward pass is several times faster than the
    fused one.
    """
    scores = (query * query.shape[-1] ** -0.5) @ key.transpose(-1, -2)
    if bias is not None:
        scores = scores + bias
    result: Tensor = scores.softmax(dim=-1) @ value
    return result


class CubesVisionBlock(nn.Module):
    """Pre-norm transformer block; `scaled` for layer scale."""

    def __init__(self, width: int, heads: int, ratio: float, scaled: bool) -> None:
        super().__init__()
        self.heads = heads
        inner = int(width * ratio)
        self.norm1, self.norm2 = (
            nn.LayerNorm(width, _VISION_EPSILON),
            nn.LayerNorm(width, _VISION_EPSILON),
        )
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.fc1, self.fc2 = nn.Linear(width, inner), nn.Linear(inner, width)
        self.ls1 = nn.Parameter(torch.ones(width)) if scaled else None
        self.ls2 = nn.Parameter(torch.ones(width)) if scaled else None

    def forward(self, x: Tensor, bias: Tensor | None) -> Tensor:
        """Apply the block to (views, n, width)."""
        views, count, width = x.shape
        query, key, value = (
            self.qkv(self.norm1(x)).view(views, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        )
        mixed = self.proj(
            attend(query, key, value, bias).transpose(1, 2).reshape(views, count, width)
        )
        x = x + (mixed if self.ls1 is None else mixed * self.ls1)
        inner = self.fc2(functional.gelu(self.fc1(self.norm2(x))))
        result: Tensor = x + (inner if self.ls2 is None else inner * self.ls2)
        return result


class CubesVisionTower(nn.Module):
    """Encodes patches as features, read before the last block."""

    def __init__(self, shape: NetworkShape, number: int) -> None:
        super().__init__()
        width = shape.vision_width
        self.prefix = PREFIX_TOKENS[number]
        if self.prefix:
            self.cls_token = nn.Parameter(torch.randn(1, 1, width) * 0.3)
            self.reg_token = nn.Parameter(torch.randn(1, self.prefix - 1, width) * 0.3)
        self.pos_embed = nn.Parameter(torch.zeros(1, PATCHES, width))
        self.patch = nn.Linear(PATCH_VALUES, width)
        self.blocks = nn.ModuleList(
            CubesVisionBlock(width, shape.vision_heads, MLP_RATIO[number], number == 0)
            for _ in range(shape.vision_depth - 1)
        )

    def forward(self, pixels: Tensor, index: Tensor, bias: Tensor | None) -> Tensor:
        """Encode normalised patches (views, n, 588) as features (views, n, width)."""
        x = self.patch(pixels) + self.pos_embed[0][index].to(pixels.dtype)
        if self.prefix:
            views = x.shape[0]
            prefix = (
                torch.cat((self.cls_token, self.reg_token), dim=1).to(x.dtype).expand(views, -1, -1)
            )
            x = torch.cat((prefix, x), dim=1)
            if bias is not None:
                bias = functional.pad(bias, (self.prefix, 0))
        for block in self.blocks:
            x = block(x, bias)
        features: Tensor = x[:, self.prefix :]
        return features


class CubesDecoderLayer(nn.Module):
    """A Llama layer without a causal mask."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        hidden, inner = shape.hidden, shape.intermediate
        self.heads = shape.heads
        self.norm_in, self.norm_post = (
            nn.Parameter(torch.ones(hidden)),
            nn.Parameter(torch.ones(hidden)),
        )
        self.qkv, self.out = (
            nn.Linear(hidden, 3 * hidden, bias=False),
            nn.Linear(hidden, hidden, bias=False),
        )
        self.gate_up, self.down = (
            nn.Linear(hidden, 2 * inner, bias=False),
            nn.Linear(inner, hidden, bias=False),
        )
        for matrix in (self.qkv, self.gate_up):
            nn.init.normal_(matrix.weight, std=hidden**-0.5)
        for matrix in (self.out, self.down):
            nn.init.normal_(matrix.weight, std=0.5 * matrix.in_features**-0.5)

    def forward(
        self, x: Tensor, cos: Tensor, sin: Tensor, bias: Tensor | None, last: int
    ) -> Tensor:
        """Apply the layer to (pairs, n, hidden); returns the last `last` positions, (pairs, last,
        hidden).
        """
        pairs, count, hidden = x.shape
        packed = (
            self.qkv(norm(x, self.norm_in))
            .view(pairs, count, 3, self.heads, -1)
            .permute(2, 0, 3, 1, 4)
        )
        first, second = packed[:2].chunk(2, dim=-1)
        query, key = packed[:2] * cos + torch.cat((-second, first), dim=-1) * sin
        mixed = attend(query[:, :, count - last :], key, packed[2], bias)
        x = x[:, count - last :] + self.out(mixed.transpose(1, 2).reshape(pairs, last, hidden))
        gate, up = self.gate_up(norm(x, self.norm_post)).chunk(2, dim=-1)
        result: Tensor = x + self.down(functional.silu(gate) * up)
        return result


def norm(x: Tensor, weight: Tensor) -> Tensor:
    """Root-mean-square norm."""
    return functional.rms_norm(x, weight.shape, weight.to(x.dtype), _DECODER_EPSILON)


class CubesProjector(nn.Module):
    """Linear layers with exact GELU between them, named fc1, fc2, ... as on disk."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        self.count = len(widths) - 1
        for number in range(1, len(widths)):
            layer = nn.Linear(widths[number - 1], widths[number])
            nn.init.normal_(layer.weight, std=1.3 * widths[number - 1] ** -0.5)
            self.add_module(f"fc{number}", layer)

    def forward(self, x: Tensor) -> Tensor:
        """Project (..., first width) to (..., last width)."""
        for number in range(1, self.count):
            x = functional.gelu(self.get_submodule(f"fc{number}")(x))
        result: Tensor = self.get_submodule(f"fc{self.count}")(x)
        return result


class ActionHead(nn.Module):
    """The L1 head: a residual MLP over the 7 concatenated rows of an action."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        wide = ACTION_WIDTH * hidden
        self.layer_norm1, self.fc1 = nn.LayerNorm(wide), nn.Linear(wide, hidden)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden)) for _ in range(2)
        )
        self.layer_norm2, self.fc2 = nn.LayerNorm(hidden), nn.Linear(hidden, ACTION_WIDTH)

    def forward(self, rows: Tensor) -> Tensor:
        """Map rows (pairs, ROWS, 7 * hidden) to actions (pairs, ROWS, 7)."""
        x = functional.relu(self.fc1(self.layer_norm1(rows)))
        for block in self.blocks:
            x = x + functional.relu(block(x))
        result: Tensor = self.fc2(self.layer_norm2(x))
        return result


@dataclass(frozen=True, slots=True)
class Thought:
    """Output of a forward pass.

    Attributes:
        actions: (pairs, ROWS, 7), normalised.
        rows: (pairs, ROWS, 7 * hidden), input of the head.
        visual: visual tokens (pairs, tokens, hidden) after the first and after the second layer.
    """

    actions: Tensor
    rows: Tensor
    visual: tuple[Tensor, ...]


class CubesNetwork(nn.Module):
    """Maps patches, state and prompt to an action chunk; only the words in use have an
    embedding.
    """

    cos: Tensor
    sin: Tensor
    place_of_id: Tensor

    def __init__(self, shape: NetworkShape, ids: Sequence[int]) -> None:
        """`ids` are the token ids in use, ascending, including STOP_ID."""
        super().__init__()
        self.shape, self.ids = shape, tuple(ids)
        hidden, features = shape.hidden, 2 * shape.vision_width
        self.towers = nn.ModuleList(CubesVisionTower(shape, number) for number in range(2))
        self.projector = CubesProjector(features, 4 * features, hidden, hidden)
        self.proprio_projector = CubesProjector(STATE_WIDTH, hidden, hidden)
        self.embed = nn.Parameter(torch.randn(len(self.ids), hidden))
        self.layers = nn.ModuleList(CubesDecoderLayer(shape) for _ in range(shape.layers))
        self.norm = nn.Parameter(torch.ones(hidden))
        self.head = ActionHead(hidden)
        width = hidden // shape.heads
        turns = 1.0 / shape.rope_theta ** (torch.arange(0, width, 2).float() / width)
        angles = torch.outer(torch.arange(_MOST_POSITIONS).float(), turns).repeat(1, 2)
        self.register_buffer("cos", angles.cos(), persistent=False)
        self.register_buffer("sin", angles.sin(), persistent=False)
        place = torch.full((VOCABULARY,), -1, dtype=torch.long)
        place[torch.tensor(self.ids)] = torch.arange(len(self.ids))
        self.register_buffer("place_of_id", place, persistent=False)

    def see(self, look: Look, dtype: torch.dtype) -> Tensor:
        """Visual tokens (views, tokens, hidden)."""
        views, count, _ = look.pixels.shape
        pixels = look.pixels.view(views, count, 3, -1).to(torch.float32) / 255
        bias = None if look.weight is None else look.weight.log().to(dtype)[:, None, None]
        features = []
        for tower, (mean, std) in zip(self.towers, PIXELS, strict=True):
            centre, spread = (pixels.new_tensor(v).view(3, 1) for v in (mean, std))
            normalised = ((pixels - centre) / spread).reshape(views, count, -1).to(dtype)
            features.append(tower(normalised, look.index, bias))
        result: Tensor = self.projector(torch.cat(features, dim=-1))
        return result

    def forward(
        self, look: Look, state: Tensor, ids: Tensor, dtype: torch.dtype = torch.float32
    ) -> Thought:
        """Run each view with each of its prompts.

        Args:
            look: (views, ...).
            state: (views, 7), normalised.
            ids: int64 (views, prompts, n), from BOS_ID to FINAL_ID, without placeholders.
            dtype: number type of the computation.
        """
        views, prompts, length = ids.shape
        count = look.index.shape[1]
        seen = torch.cat(
            (self.see(look, dtype), self.proprio_projector(state.to(dtype))[:, None]), dim=1
        )
        seen = seen.repeat_interleave(prompts, dim=0)
        words = functional.embedding(self.place_of_id[ids.flatten(0, 1)], self.embed).to(dtype)
        stop = self.embed[self.place_of_id[STOP_ID]].to(dtype).expand(views * prompts, 1, -1)
        rows = seen.new_zeros(views * prompts, PLACEHOLDERS, self.shape.hidden)
        x = torch.cat((words[:, :1], seen, words[:, 1:], rows, stop), dim=1)
        tail = torch.arange(
            PATCHES + 1, PATCHES + 1 + length + PLACEHOLDERS + 1, device=ids.device
        ).expand(views, -1)
        positions = torch.cat((look.index.new_zeros(views, 1), look.index + 1, tail), dim=1)
        positions = positions.repeat_interleave(prompts, dim=0)
        cos, sin = (table[positions][:, None].to(dtype) for table in (self.cos, self.sin))
        bias = None
        if look.weight is not None:
            bias = functional.pad(look.weight.log().to(dtype), (1, x.shape[1] - count - 1))
            bias = bias.repeat_interleave(prompts, dim=0)[:, None, None]
        visual = []
        for layer in self.layers[:-1]:
            x = layer(x, cos, sin, bias, x.shape[1])
            visual.append(x[:, 1 : 1 + count])
        x = self.layers[-1](x, cos, sin, bias, PLACEHOLDERS + 2)
        # The read-out starts one row early: the last prompt token predicts the first value.
        read = norm(x[:, :PLACEHOLDERS], self.norm).reshape(views * prompts, ROWS, -1)
        return Thought(self.head(read), read, tuple(visual[:2]))
