"""pi0 as PyTorch modules, for inference of one sample: nothing masked is computed, everything
constant only once.

Missing cameras and prompt padding take no positions, so leaving them out is the same as masking
them. The state token sees only the prefix, so its keys and values are constant over the Euler steps
and join the prefix cache.
"""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.guidance import CleanPrefix, Guide
from rn_backend_pi0.layers import Gemma, KeyValue, Rotary, VisionTower


class Pi0Network(nn.Module):
    """The whole model. Parameters are named as in `architecture.module_keys`; projections at the
    border are float32.
    """

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
            times: flow time at each Euler step, from 1 downwards; their number is the number of
                steps.
            prefix: rows to continue; None for a chunk of its own.

        Returns:
            float32 (dims.chunk, dims.action), normalised.
        """
        needs_gradient = prefix is not None and prefix.jacobian == "full" and not prefix.trained
        # Tensors made in inference mode cannot be differentiated through; no_grad allows it where
        # it is asked for.
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
        self._fill_state(
            self.state_proj(state)[None].to(dtype), _part(rotary, length, length + 1), cache, length
        )
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
        """(images x tokens + prompt, width): images as they are, the prompt scaled by
        sqrt(width).
        """
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
        """Run the language model over the prefix; returns each layer's cache with room for state
        and actions.
        """
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
        """Run the expert over the state token, which sees the prefix and itself, and write its keys
        and values.
        """
        for index, layer in enumerate(self.expert.blocks()):
            normed = layer.input_layernorm(x)
            _write(cache[index], layer.keys_values(normed, rotary), position)
            if index < self.dims.expert.depth - 1:
                x = layer(x, normed, rotary, _until(cache[index], position + 1))

    def _velocity(
        self, x: Tensor, rotary: Rotary, cache: list[KeyValue], position: int, *, keep: bool = False
    ) -> Tensor:
        """Run the expert over the action tokens, which see everything; float32 (chunk,
        dims.action).

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

        The sinusoid is computed in float64: its highest frequency is 1571 rad, so float32 angles
        are off by 1e-4. Source: openpi, create_sinusoidal_pos_embedding.
        """
        dims = self.dims
        share = torch.linspace(0.0, 1.0, dims.expert.width // 2, dtype=torch.float64)
        period = dims.min_period * (dims.max_period / dims.min_period) ** share
        angles = torch.tensor(times, dtype=torch.float64)[:, None] * (2 * math.pi / period)
        embedding = torch.cat([angles.sin(), angles.cos()], dim=1).to(
            device=device, dtype=torch.float32
        )
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
