"""The flow network, trainable and batched: the same function that rn-backend-pi0 computes from the
exported checkpoint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_policy_cubes.flow.recipe import FLOW_ROWS, FlowShape
from rn_policy_cubes.network import Look, attend
from rn_policy_cubes.recipe import ACTION_WIDTH, PATCH_VALUES, PATCHES, STATE_WIDTH

_EPSILON = 1e-6
_MOST_POSITIONS = 1024
_HIDDEN = -30_000.0
"""Score of a key that a query does not see."""


class FlowVisionBlock(nn.Module):
    """Pre-norm transformer block of SigLIP."""

    def __init__(self, shape: FlowShape) -> None:
        super().__init__()
        width, inner = shape.vision_width, shape.vision_inner
        self.heads = shape.vision_heads
        self.norm1, self.norm2 = nn.LayerNorm(width, _EPSILON), nn.LayerNorm(width, _EPSILON)
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.fc1, self.fc2 = nn.Linear(width, inner), nn.Linear(inner, width)

    def forward(self, x: Tensor, bias: Tensor | None) -> Tensor:
        """Apply the block to (views, n, width)."""
        views, count, width = x.shape
        query, key, value = (
            self.qkv(self.norm1(x)).view(views, count, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        )
        mixed = attend(query, key, value, bias).transpose(1, 2).reshape(views, count, width)
        x = x + self.proj(mixed)
        hidden = functional.gelu(self.fc1(self.norm2(x)), approximate="tanh")
        result: Tensor = x + self.fc2(hidden)
        return result


class FlowLayer(nn.Module):
    """A Gemma layer; with `keys_only` only its projections to keys and values."""

    def __init__(self, shape: FlowShape, width: int, inner: int, keys_only: bool = False) -> None:
        super().__init__()
        self.heads = shape.heads
        mixed = shape.heads * shape.head_width
        self.norm_in = nn.Parameter(torch.zeros(width))
        self.kv = nn.Linear(width, 2 * mixed, bias=False)
        nn.init.normal_(self.kv.weight, std=width**-0.5)
        if keys_only:
            return
        self.norm_post = nn.Parameter(torch.zeros(width))
        self.query = nn.Linear(width, mixed, bias=False)
        self.out = nn.Linear(mixed, width, bias=False)
        self.gate_up, self.down = (
            nn.Linear(width, 2 * inner, bias=False),
            nn.Linear(inner, width, bias=False),
        )
        for matrix in (self.query, self.gate_up):
            nn.init.normal_(matrix.weight, std=width**-0.5)
        for matrix in (self.out, self.down):
            nn.init.normal_(matrix.weight, std=0.5 * matrix.in_features**-0.5)

    def keys(self, normed: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
        """Rotated keys, and values, (pairs, heads, n, head width) each."""
        pairs, count, _ = normed.shape
        key, value = self.kv(normed).view(pairs, count, 2, self.heads, -1).permute(2, 0, 3, 1, 4)
        return _turned(key, cos, sin), value

    def forward(
        self,
        x: Tensor,
        cos: Tensor,
        sin: Tensor,
        bias: Tensor | None,
        before: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Apply the layer to (pairs, n, width), whose tokens attend to `before`, keys and values,
        and to each other.

        Returns:
            The result, and its own keys and values.
        """
        pairs, count, _ = x.shape
        normed = gemma_norm(x, self.norm_in)
        key, value = self.keys(normed, cos, sin)
        query = self.query(normed).view(pairs, count, self.heads, -1).transpose(1, 2)
        query = _turned(query, cos, sin)
        if before is None:
            mixed = attend(query, key, value, bias)
        else:
            all_keys = torch.cat((before[0], key), dim=2)
            mixed = attend(query, all_keys, torch.cat((before[1], value), dim=2), bias)
        x = x + self.out(mixed.transpose(1, 2).reshape(pairs, count, -1))
        gate, up = self.gate_up(gemma_norm(x, self.norm_post)).chunk(2, dim=-1)
        result: Tensor = x + self.down(functional.gelu(gate, approximate="tanh") * up)
        return result, key, value


class FlowKeys(nn.Module):
    """The last layer of the language model: keys and values for the expert."""

    def __init__(self, shape: FlowShape) -> None:
        super().__init__()
        self.layer = FlowLayer(shape, shape.hidden, shape.intermediate, keys_only=True)

    def forward(self, x: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of (pairs, n, hidden)."""
        return self.layer.keys(gemma_norm(x, self.layer.norm_in), cos, sin)


def gemma_norm(x: Tensor, weight: Tensor) -> Tensor:
    """Root-mean-square norm; the weight is an offset to 1."""
    return functional.rms_norm(x, weight.shape, (1.0 + weight).to(x.dtype), _EPSILON)


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    first, second = x.chunk(2, dim=-1)
    return x * cos + torch.cat((-second, first), dim=-1) * sin


@dataclass(frozen=True, slots=True)
class FlowPrefix:
    """The language model's result for a batch of pairs.

    Attributes:
        caches: keys and values of each layer.
        bias: (pairs, 1, 1, n), logarithm of what each key stands for; None for 1 each.
        end: position after the last token.
        visual: visual tokens (pairs, tokens, hidden) after the first and after the second layer.
    """

    caches: tuple[tuple[Tensor, Tensor], ...]
    bias: Tensor | None
    end: int
    visual: tuple[Tensor, ...]


@dataclass(frozen=True, slots=True)
class FlowThought:
    """Output of the expert.

    Attributes:
        velocity: float32 (pairs, samples, FLOW_ROWS, 7).
        state: (pairs, width), the state's token before the last layer.
        rows: (pairs, samples, width), mean of the action tokens after the last layer.
    """

    velocity: Tensor
    state: Tensor
    rows: Tensor


class CubesFlowNetwork(nn.Module):
    """Maps patches, state, prompt and a noisy action chunk to the velocity of the flow; time runs
    from 1 (noise) to 0 (actions).
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, shape: FlowShape, vocabulary: int) -> None:
        super().__init__()
        self.shape, self.vocabulary = shape, vocabulary
        hidden, width = shape.hidden, shape.expert
        self.patch = nn.Linear(PATCH_VALUES, shape.vision_width)
        self.pos_embed = nn.Parameter(torch.zeros(PATCHES, shape.vision_width))
        self.blocks = nn.ModuleList(FlowVisionBlock(shape) for _ in range(shape.vision_depth))
        self.post_norm = nn.LayerNorm(shape.vision_width, _EPSILON)
        self.projector = nn.Linear(shape.vision_width, hidden)
        nn.init.normal_(self.projector.weight, std=shape.vision_width**-0.5)
        self.embed = nn.Parameter(torch.randn(vocabulary, hidden) * hidden**-0.5)
        self.layers = nn.ModuleList(
            FlowLayer(shape, hidden, shape.intermediate) for _ in range(shape.layers - 1)
        )
        self.last = FlowKeys(shape)
        self.expert = nn.ModuleList(
            FlowLayer(shape, width, shape.expert_intermediate) for _ in range(shape.layers)
        )
        self.expert_norm = nn.Parameter(torch.zeros(width))
        self.state_proj = nn.Linear(STATE_WIDTH, width)
        self.action_in, self.action_out = (
            nn.Linear(ACTION_WIDTH, width),
            nn.Linear(width, ACTION_WIDTH),
        )
        self.time_in, self.time_out = nn.Linear(2 * width, width), nn.Linear(width, width)
        nn.init.normal_(self.state_proj.weight, std=1.0)
        nn.init.normal_(self.action_in.weight, std=1.0)
        nn.init.normal_(self.action_out.weight, std=0.1 * width**-0.5)
        for matrix in (self.time_in, self.time_out):
            nn.init.normal_(matrix.weight, std=1.3 * width**-0.5)
        turns = 1.0 / shape.rope_theta ** (
            torch.arange(0, shape.head_width, 2).float() / shape.head_width
        )
        angles = torch.outer(torch.arange(_MOST_POSITIONS).float(), turns).repeat(1, 2)
        self.register_buffer("cos", angles.cos(), persistent=False)
        self.register_buffer("sin", angles.sin(), persistent=False)

    def see(self, look: Look, dtype: torch.dtype) -> Tensor:
        """Visual tokens (views, tokens, hidden)."""
        pixels = (look.pixels.to(torch.float32) / 255 * 2 - 1).to(dtype)
        bias = None if look.weight is None else look.weight.log().to(dtype)[:, None, None]
        x = self.patch(pixels) + self.pos_embed[look.index].to(dtype)
        for block in self.blocks:
            x = block(x, bias)
        result: Tensor = self.projector(self.post_norm(x))
        return result

    def read(self, look: Look, ids: Tensor, dtype: torch.dtype = torch.float32) -> FlowPrefix:
        """Run the language model over each view with each of its prompts.

        Args:
            look: (views, ...).
            ids: int64 (views, prompts, n), from BOS to the newline.
            dtype: number type of the computation.
        """
        views, prompts, length = ids.shape
        count = look.index.shape[1]
        seen = self.see(look, dtype).repeat_interleave(prompts, dim=0)
        scale = math.sqrt(self.shape.hidden)
        words = functional.embedding(ids.flatten(0, 1), self.embed).to(dtype) * scale
        x = torch.cat((seen, words), dim=1)
        text = torch.arange(PATCHES, PATCHES + length, device=ids.device).expand(views, -1)
        positions = torch.cat((look.index, text), dim=1).repeat_interleave(prompts, dim=0)
        cos, sin = self._rotary(positions, dtype)
        bias = None
        if look.weight is not None:
            bias = functional.pad(look.weight.log().to(dtype), (0, length))
            bias = bias.repeat_interleave(prompts, dim=0)[:, None, None]
        caches, visual = [], []
        for layer in self.layers:
            x, key, value = layer(x, cos, sin, bias, None)
            caches.append((key, value))
            visual.append(x[:, :count])
        caches.append(self.last(x, cos, sin))
        return FlowPrefix(tuple(caches), bias, PATCHES + length, tuple(visual[:2]))

    def forward(
        self,
        prefix: FlowPrefix,
        state: Tensor,
        noisy: Tensor,
        times: Tensor,
        dtype: torch.dtype = torch.float32,
    ) -> FlowThought:
        """The velocity of each sample of each pair.

        Args:
            prefix: of `read`.
            state: (views, 7), normalised.
            noisy: float32 (pairs, samples, FLOW_ROWS, 7), time * noise + (1 - time) * actions.
            times: float32 (pairs, samples).
            dtype: number type of the layers; projections at the border are float32.
        """
        pairs, samples, rows, _ = noisy.shape
        with torch.autocast(noisy.device.type, enabled=False):
            first = self.state_proj(state.float()).repeat_interleave(pairs // len(state), dim=0)
            moment = self.sinusoids(times)[:, :, None].expand(-1, -1, rows, -1)
            mixed = self.time_in(torch.cat((self.action_in(noisy), moment), dim=-1))
            actions = self.time_out(functional.silu(mixed)).flatten(1, 2)
        x = torch.cat((first[:, None], actions), dim=1).to(dtype)
        places = torch.arange(prefix.end + 1, prefix.end + 1 + rows, device=x.device)
        positions = torch.cat((places[:1] - 1, places.repeat(samples)))
        cos, sin = self._rotary(positions[None], dtype)
        keys = prefix.caches[0][0].shape[2]
        bias = self._hidden(samples, rows, keys, x)
        if prefix.bias is not None:
            bias = bias + functional.pad(prefix.bias, (0, x.shape[1]))
        for number, (layer, cache) in enumerate(zip(self.expert, prefix.caches, strict=True)):
            if number == self.shape.layers - 1:
                told = x[:, 0]
            x, _, _ = layer(x, cos, sin, bias, cache)
        read = gemma_norm(x[:, 1:], self.expert_norm).view(pairs, samples, rows, -1)
        with torch.autocast(noisy.device.type, enabled=False):
            velocity = self.action_out(read.float())
        return FlowThought(velocity, told, read.mean(dim=2))

    def sinusoids(self, times: Tensor) -> Tensor:
        """Sines and cosines of flow times: float32 (..., expert width).

        Source: openpi, create_sinusoidal_pos_embedding.
        """
        shape = self.shape
        share = torch.linspace(
            0.0, 1.0, shape.expert // 2, dtype=torch.float64, device=times.device
        )
        period = shape.min_period * (shape.max_period / shape.min_period) ** share
        angles = times.double()[..., None] * (2 * math.pi / period)
        return torch.cat((angles.sin(), angles.cos()), dim=-1).float()

    @torch.no_grad()
    def sample(
        self,
        look: Look,
        state: Tensor,
        ids: Tensor,
        noise: Tensor,
        steps: int,
        dtype: torch.dtype = torch.float32,
    ) -> Tensor:
        """Integrate the flow in Euler steps from noise (pairs, FLOW_ROWS, 7) to normalised
        actions.
        """
        prefix = self.read(look, ids, dtype)
        x = noise
        for step in range(steps):
            times = x.new_full((len(x), 1), 1.0 - step / steps)
            x = x - self(prefix, state, x[:, None], times, dtype).velocity[:, 0] / steps
        return x

    def _rotary(self, positions: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        return self.cos[positions][:, None].to(dtype), self.sin[positions][:, None].to(dtype)

    def _hidden(self, samples: int, rows: int, keys: int, like: Tensor) -> Tensor:
        """Bias (1, 1, n, keys + n): the state sees the prefix and itself; an action sees these and
        the actions of its own sample.
        """
        sample = torch.arange(samples, device=like.device).repeat_interleave(rows)
        number = torch.cat((sample.new_full((1,), -1), sample))
        is_seen = (number[None] == number[:, None]) | (number[None] == -1)
        own = torch.where(is_seen, 0.0, _HIDDEN).to(like.dtype)
        return functional.pad(own, (keys, 0))[None, None]


def chunk_shape() -> tuple[int, int]:
    """Shape of the noise of one pair."""
    return FLOW_ROWS, ACTION_WIDTH
