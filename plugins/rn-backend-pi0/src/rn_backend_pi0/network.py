"""pi0 as PyTorch modules, for inference of one sample: nothing masked is computed, everything constant only once.

Missing cameras and prompt padding take no positions, so leaving them out is the same as masking them. The state token
sees only the prefix, so its keys and values are constant over the Euler steps and join the prefix cache.
"""

from __future__ import annotations

import math
from functools import partial
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.architecture import GemmaDims, Pi0Dims, VisionDims
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.guidance import CleanPrefix, Guide

KeyValue = tuple[Tensor, Tensor]
Rotary = tuple[Tensor, Tensor]


class VisionLayer(nn.Module):
    """One pre-norm transformer block of SigLIP."""

    def __init__(self, dims: VisionDims) -> None:
        super().__init__()
        self.heads = dims.heads
        self.layer_norm1 = nn.LayerNorm(dims.width, eps=dims.norm_eps)
        self.layer_norm2 = nn.LayerNorm(dims.width, eps=dims.norm_eps)
        parts = ("q_proj", "k_proj", "v_proj", "out_proj")
        self.self_attn = nn.ModuleDict({part: nn.Linear(dims.width, dims.width) for part in parts})
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(dims.width, dims.mlp), "fc2": nn.Linear(dims.mlp, dims.width)})

    def forward(self, x: Tensor) -> Tensor:
        """(cameras, tokens, width) -> the same shape."""
        count, tokens, width = x.shape
        normed = self.layer_norm1(x)
        q, k, v = (
            self.self_attn[part](normed).view(count, tokens, self.heads, -1).transpose(1, 2)
            for part in ("q_proj", "k_proj", "v_proj")
        )
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(count, tokens, width)
        x = x + self.self_attn["out_proj"](mixed)
        hidden = F.gelu(self.mlp["fc1"](self.layer_norm2(x)), approximate="tanh")
        out: Tensor = x + self.mlp["fc2"](hidden)
        return out


class VisionTower(nn.Module):
    """SigLIP: pixels to tokens."""

    def __init__(self, dims: VisionDims) -> None:
        super().__init__()
        self.patch_embedding = nn.Conv2d(3, dims.width, kernel_size=dims.patch, stride=dims.patch)
        self.position_embedding = nn.Parameter(torch.empty(dims.tokens, dims.width))
        self.layers = nn.ModuleList(VisionLayer(dims) for _ in range(dims.depth))
        self.post_layernorm = nn.LayerNorm(dims.width, eps=dims.norm_eps)

    def forward(self, pixels: Tensor) -> Tensor:
        """(cameras, 3, H, W) in -1..1 -> (cameras, tokens, width)."""
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
        """(tokens, width) -> the same shape and dtype."""
        wide = x.float()
        wide = wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + self.eps)
        return (wide * (1.0 + self.weight.float())).to(x.dtype)


def _rotate(x: Tensor, rotary: Rotary) -> Tensor:
    cos, sin = rotary
    first, second = x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, second * cos + first * sin], dim=-1)


class GemmaLayer(nn.Module):
    """One Gemma block; with `keys_only` it holds just what yields keys and values."""

    def __init__(self, dims: GemmaDims, *, keys_only: bool = False) -> None:
        super().__init__()
        self.dims = dims
        queries, keys = dims.heads * dims.head_dim, dims.kv_heads * dims.head_dim
        self.input_layernorm = RmsNorm(dims.width, dims.norm_eps)
        self.self_attn = nn.ModuleDict(
            {
                "k_proj": nn.Linear(dims.width, keys, bias=False),
                "v_proj": nn.Linear(dims.width, keys, bias=False),
            }
        )
        if not keys_only:
            self.self_attn["q_proj"] = nn.Linear(dims.width, queries, bias=False)
            self.self_attn["o_proj"] = nn.Linear(queries, dims.width, bias=False)
            self.post_attention_layernorm = RmsNorm(dims.width, dims.norm_eps)
            self.mlp = nn.ModuleDict(
                {
                    "gate_proj": nn.Linear(dims.width, dims.mlp, bias=False),
                    "up_proj": nn.Linear(dims.width, dims.mlp, bias=False),
                    "down_proj": nn.Linear(dims.mlp, dims.width, bias=False),
                }
            )

    def keys_values(self, normed: Tensor, rotary: Rotary) -> KeyValue:
        """(tokens, width), already normed -> keys and values (kv_heads, tokens, head_dim), keys rotated."""
        shape = (normed.shape[0], self.dims.kv_heads, self.dims.head_dim)
        key = self.self_attn["k_proj"](normed).view(shape).transpose(0, 1)
        value = self.self_attn["v_proj"](normed).view(shape).transpose(0, 1)
        return _rotate(key, rotary), value

    def forward(self, x: Tensor, normed: Tensor, rotary: Rotary, cached: KeyValue) -> Tensor:
        """(tokens, width) -> the same shape, every token attending to all of `cached`."""
        dims, tokens = self.dims, x.shape[0]
        groups = dims.heads // dims.kv_heads
        query = self.self_attn["q_proj"](normed).view(tokens, dims.heads, dims.head_dim).transpose(0, 1)
        query = _rotate(query, rotary).reshape(dims.kv_heads, groups * tokens, dims.head_dim)
        key, value = cached
        # Nothing is masked, so the heads of one key head are just more queries.
        mixed = F.scaled_dot_product_attention(query[None], key[None], value[None])[0]
        mixed = mixed.reshape(dims.heads, tokens, dims.head_dim).transpose(0, 1).reshape(tokens, -1)
        x = x + self.self_attn["o_proj"](mixed)
        hidden = self.post_attention_layernorm(x)
        gate = F.gelu(self.mlp["gate_proj"](hidden), approximate="tanh")
        out: Tensor = x + self.mlp["down_proj"](gate * self.mlp["up_proj"](hidden))
        return out


class Gemma(nn.Module):
    """A stack of Gemma blocks; `keys_only_last` for the prefix, whose last hidden state nobody reads."""

    def __init__(self, dims: GemmaDims, *, keys_only_last: bool) -> None:
        super().__init__()
        self.dims = dims
        self.layers = nn.ModuleList(
            GemmaLayer(dims, keys_only=keys_only_last and index == dims.depth - 1) for index in range(dims.depth)
        )
        if not keys_only_last:
            self.norm = RmsNorm(dims.width, dims.norm_eps)

    def blocks(self) -> list[GemmaLayer]:
        """The layers, typed."""
        return [cast("GemmaLayer", layer) for layer in self.layers]


class Pi0Network(nn.Module):
    """The whole model. Parameters are named as in `architecture.module_keys`; projections at the border are float32."""

    def __init__(self, dims: Pi0Dims) -> None:
        super().__init__()
        self.dims = dims
        width = dims.expert.width
        self.vision = VisionTower(dims.vision)
        self.projector = nn.Linear(dims.vision.width, dims.prefix.width)
        self.embedding = nn.Embedding(dims.vocabulary, dims.prefix.width)
        self.prefix = Gemma(dims.prefix, keys_only_last=True)
        self.expert = Gemma(dims.expert, keys_only_last=False)
        self.state_proj = nn.Linear(dims.state, width)
        self.action_in_proj = nn.Linear(dims.action, width)
        self.action_time_mlp_in = nn.Linear(2 * width, width)
        self.action_time_mlp_out = nn.Linear(width, width)
        self.action_out_proj = nn.Linear(width, dims.action)

    def sample_actions(
        self,
        pixels: Tensor,
        token_ids: Tensor,
        state: Tensor,
        noise: Tensor,
        times: tuple[float, ...],
        prefix: Prefix | None = None,
    ) -> Tensor:
        """Integrate the flow from noise at t = 1 to actions at t = 0.

        Args:
            pixels: float32 (cameras >= 1, 3, H, W) in -1..1, present cameras only, in slot order.
            token_ids: int64 (n,), the prompt without padding.
            state: float32 (dims.state,), normalised and zero-padded.
            noise: float32 (dims.chunk, dims.action).
            times: flow time at each Euler step, from 1 downwards; their number is the number of steps.
            prefix: rows to continue; None for a chunk of its own.

        Returns:
            float32 (dims.chunk, dims.action), normalised.
        """
        needs_gradient = prefix is not None and prefix.jacobian == "full" and not prefix.trained
        # Tensors made in inference mode cannot be differentiated through; no_grad allows it where it is asked for.
        with torch.no_grad() if needs_gradient else torch.inference_mode():
            return self._integrate(pixels, token_ids, state, noise, times, prefix)

    def _integrate(
        self,
        pixels: Tensor,
        token_ids: Tensor,
        state: Tensor,
        noise: Tensor,
        times: tuple[float, ...],
        prefix: Prefix | None,
    ) -> Tensor:
        dims, device, dtype = self.dims, noise.device, self.projector.weight.dtype
        embedded = self._embed_prefix(pixels.to(dtype), token_ids)
        length = embedded.shape[0]
        rotary = self._rotary(length + 1 + dims.chunk, device, dtype)
        cache = self._fill_prefix(embedded, _part(rotary, 0, length))
        self._fill_state(self.state_proj(state)[None].to(dtype), _part(rotary, length, length + 1), cache, length)
        time_terms = self._time_terms(times, device)
        action_weight = self.action_time_mlp_in.weight[:, : dims.expert.width]
        suffix_rotary = _part(rotary, length + 1, length + 1 + dims.chunk)
        guide = clean = None
        if prefix is not None and prefix.trained:
            clean = CleanPrefix.of(prefix, noise, self._time_terms((0.0,), device))
        elif prefix is not None:
            guide = Guide.of(prefix, noise, times)

        def velocity(x: Tensor, term: Tensor, *, keep: bool = False) -> Tensor:
            hidden = F.silu(F.linear(self.action_in_proj(x), action_weight) + term)
            hidden = self.action_time_mlp_out(hidden).to(dtype)
            return self._velocity(hidden, suffix_rotary, cache, length + 1, keep=keep)

        step = -1.0 / len(times)
        x = noise
        for index, term in enumerate(time_terms):
            if clean is not None:
                x = clean.put(x)
                term = clean.terms(term)
            if guide is None:
                v = velocity(x, term)
            elif guide.is_full:
                v = guide.bend_fully(x, index, partial(velocity, term=term, keep=True))
            else:
                v = guide.bend(x, velocity(x, term), index)
            x = x + step * v
        return x if clean is None else clean.put(x)

    def _embed_prefix(self, pixels: Tensor, token_ids: Tensor) -> Tensor:
        """(images x tokens + prompt, width): images as they are, the prompt scaled by sqrt(width)."""
        images = self.projector(self.vision(pixels)).flatten(0, 1)
        return torch.cat([images, self.embedding(token_ids) * math.sqrt(self.dims.prefix.width)])

    def _rotary(self, length: int, device: torch.device, dtype: torch.dtype) -> Rotary:
        head_dim = self.dims.prefix.head_dim
        exponents = torch.arange(0, head_dim, 2, device=device, dtype=torch.float32) / head_dim
        angles = torch.arange(length, device=device, dtype=torch.float32)[:, None] / (
            self.dims.prefix.rope_base**exponents
        )
        return angles.cos().to(dtype), angles.sin().to(dtype)

    def _fill_prefix(self, x: Tensor, rotary: Rotary) -> list[KeyValue]:
        """Run the language model over the prefix; returns each layer's cache with room for state and actions."""
        dims = self.dims.prefix
        room = 1 + self.dims.chunk
        cache: list[KeyValue] = []
        for index, layer in enumerate(self.prefix.blocks()):
            normed = layer.input_layernorm(x)
            key, value = layer.keys_values(normed, rotary)
            cache.append((F.pad(key, (0, 0, 0, room)), F.pad(value, (0, 0, 0, room))))
            if index < dims.depth - 1:
                x = layer(x, normed, rotary, (key, value))
        return cache

    def _fill_state(self, x: Tensor, rotary: Rotary, cache: list[KeyValue], position: int) -> None:
        """Run the expert over the state token, which sees the prefix and itself, and write its keys and values."""
        for index, layer in enumerate(self.expert.blocks()):
            normed = layer.input_layernorm(x)
            _write(cache[index], layer.keys_values(normed, rotary), position)
            if index < self.dims.expert.depth - 1:
                x = layer(x, normed, rotary, _until(cache[index], position + 1))

    def _velocity(
        self, x: Tensor, rotary: Rotary, cache: list[KeyValue], position: int, *, keep: bool = False
    ) -> Tensor:
        """Run the expert over the action tokens, which see everything; float32 (chunk, dims.action).

        With `keep` the cache stays as it is, as a backward pass needs it.
        """
        for index, layer in enumerate(self.expert.blocks()):
            normed = layer.input_layernorm(x)
            new = layer.keys_values(normed, rotary)
            if keep:
                seen = _joined(_until(cache[index], position), new)
            else:
                _write(cache[index], new, position)
                seen = cache[index]
            x = layer(x, normed, rotary, seen)
        out: Tensor = self.action_out_proj(self.expert.norm(x).float())
        return out

    def _time_terms(self, times: tuple[float, ...], device: torch.device) -> Tensor:
        """What each flow time adds before the SiLU: float32 (steps, expert width).

        The sinusoid is computed in float64: its highest frequency is 1571 rad, so float32 angles are off by 1e-4.
        Source: openpi, create_sinusoidal_pos_embedding.
        """
        dims = self.dims
        share = torch.linspace(0.0, 1.0, dims.expert.width // 2, dtype=torch.float64)
        period = dims.min_period * (dims.max_period / dims.min_period) ** share
        angles = torch.tensor(times, dtype=torch.float64)[:, None] * (2 * math.pi / period)
        embedding = torch.cat([angles.sin(), angles.cos()], dim=1).to(device=device, dtype=torch.float32)
        layer = self.action_time_mlp_in
        return F.linear(embedding, layer.weight[:, dims.expert.width :], layer.bias)


def _part(rotary: Rotary, start: int, stop: int) -> Rotary:
    return rotary[0][start:stop], rotary[1][start:stop]


def _until(cached: KeyValue, stop: int) -> KeyValue:
    return cached[0][:, :stop], cached[1][:, :stop]


def _joined(cached: KeyValue, new: KeyValue) -> KeyValue:
    return torch.cat([cached[0], new[0]], dim=1), torch.cat([cached[1], new[1]], dim=1)


def _write(cached: KeyValue, new: KeyValue, position: int) -> None:
    stop = position + new[0].shape[1]
    cached[0][:, position:stop] = new[0]
    cached[1][:, position:stop] = new[1]
