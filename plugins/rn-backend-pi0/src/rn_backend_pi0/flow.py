"""Common base of the flow-matching models, for inference of one sample: masked positions are not
computed, and constants are computed once.

Missing cameras and prompt padding occupy no positions, so leaving them out equals masking them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.chunking import Prefix
from rn_backend_pi0.guidance import CleanPrefix, Guide
from rn_backend_pi0.layers import KeyValue, Rotary
from rn_backend_pi0.prefix import PrefixNetwork


class FlowNetwork(PrefixNetwork, ABC):
    """Computes a cache of keys and values from images and text, and integrates the flow on top of
    it. Projections at the border are float32.
    """

    state_tokens: ClassVar[int]
    """Number of tokens between the prompt and the actions that hold the state."""

    def __init__(self, dims: Pi0Dims) -> None:
        super().__init__(dims, keys_only_last=True)
        width = dims.expert.width
        self.action_in_proj = nn.Linear(dims.action, width)
        self.action_out_proj = nn.Linear(width, dims.action)

    @abstractmethod
    def time_terms(self, times: tuple[float, ...], device: torch.device) -> Tensor:
        """Inputs of `velocity` for each flow time: float32 (steps, any width)."""

    @abstractmethod
    def fill_state(self, state: Tensor, rotary: Rotary, cache: list[KeyValue], length: int) -> None:
        """Write keys and values of the state tokens behind the `length` tokens of the prefix."""

    @abstractmethod
    def velocity(
        self,
        x: Tensor,
        term: Tensor,
        rotary: Rotary,
        cache: list[KeyValue],
        position: int,
        *,
        keep: bool = False,
    ) -> Tensor:
        """The flow at `x`, float32 (chunk, dims.action).

        Args:
            x: float32 (chunk, dims.action).
            term: one row of `time_terms`, or one for each action.
            rotary: rotary embedding of the action tokens.
            cache: cache of all layers; the action tokens are written from `position` on.
            position: number of tokens before the actions.
            keep: do not modify the cache, because a backward pass needs it.
        """

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
            prefix: rows to continue; None for an independent chunk.

        Returns:
            float32 (dims.chunk, dims.action), normalised.
        """
        needs_gradient = prefix is not None and prefix.jacobian == "full" and not prefix.trained
        # Tensors created in inference mode cannot be differentiated through; under no_grad
        # gradients can be enabled locally.
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
        embedded = self.embed_prefix(pixels.to(dtype), token_ids)
        length = embedded.shape[0]
        start = length + self.state_tokens
        rotary = self.rotary_of(start + dims.chunk, device, dtype)
        cache = self._fill_prefix(embedded, part_of(rotary, 0, length))
        self.fill_state(state, part_of(rotary, length, start), cache, length)
        time_terms = self.time_terms(times, device)
        suffix_rotary = part_of(rotary, start, start + dims.chunk)
        guide = clean = None
        if prefix is not None and prefix.trained:
            clean = CleanPrefix.of(prefix, noise, self.time_terms((0.0,), device))
        elif prefix is not None:
            guide = Guide.of(prefix, noise, times)

        velocity = partial(self.velocity, rotary=suffix_rotary, cache=cache, position=start)
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

    def _fill_prefix(self, x: Tensor, rotary: Rotary) -> list[KeyValue]:
        """Run the language model over the prefix; returns each layer's cache with room for state
        and actions.
        """
        dims = self.dims.prefix
        room = self.state_tokens + self.dims.chunk
        cache: list[KeyValue] = []
        for index, layer in enumerate(self.prefix.blocks()):
            normed = layer.input_layernorm(x)
            key, value = layer.keys_values(normed, rotary)
            cache.append((F.pad(key, (0, 0, 0, room)), F.pad(value, (0, 0, 0, room))))
            if index < dims.depth - 1:
                x = layer(x, normed, rotary, (key, value))
        return cache

    def sinusoids(self, times: tuple[float, ...], device: torch.device) -> Tensor:
        """Sines and cosines of each flow time: float32 (steps, expert width).

        They are computed in float64: the highest frequency is 1571 rad, so float32 angles are off
        by 1e-4. Source: openpi, create_sinusoidal_pos_embedding.
        """
        dims = self.dims
        share = torch.linspace(0.0, 1.0, dims.expert.width // 2, dtype=torch.float64)
        period = dims.min_period * (dims.max_period / dims.min_period) ** share
        angles = torch.tensor(times, dtype=torch.float64)[:, None] * (2 * math.pi / period)
        return torch.cat([angles.sin(), angles.cos()], dim=1).to(device=device, dtype=torch.float32)

    def seen_by(self, cached: KeyValue, new: KeyValue, position: int, *, keep: bool) -> KeyValue:
        """Cached keys and values together with `new`, those of the action tokens."""
        if keep:
            return _joined(until(cached, position), new)
        write(cached, new, position)
        return cached


def part_of(rotary: Rotary, start: int, stop: int) -> Rotary:
    """The rotary embedding of tokens `start` to `stop`."""
    return rotary[0][start:stop], rotary[1][start:stop]


def until(cached: KeyValue, stop: int) -> KeyValue:
    """Keys and values of the first `stop` tokens."""
    return cached[0][:, :stop], cached[1][:, :stop]


def _joined(cached: KeyValue, new: KeyValue) -> KeyValue:
    return torch.cat([cached[0], new[0]], dim=1), torch.cat([cached[1], new[1]], dim=1)


def write(cached: KeyValue, new: KeyValue, position: int) -> None:
    """Write `new` into the cache, from token `position` on."""
    stop = position + new[0].shape[1]
    cached[0][:, position:stop] = new[0]
    cached[1][:, position:stop] = new[1]
